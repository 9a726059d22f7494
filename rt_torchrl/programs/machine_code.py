"""Programs as LLVM's intermediate language, over lanes of realisations."""

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rt_torchrl.programs.lowering import Lowering
from rt_torchrl.programs.operations import FORMS
from rt_torchrl.programs.program import Program
from rt_torchrl.programs.vector_functions import Lanes, symbol

PURE = "memory(none) nounwind willreturn speculatable"
"""Attributes of mathematical functions, by which LLVM computes once what is the same in all steps."""
WIDTH = "align 8"  # torch aligns rows to doubles
DRIVE = "ptr noalias %x, i64 %first, i64 %last, i64 %row"
STACK = 2**17
"""Bytes of arrays that lie on the stack, which is 512 KiB in the threads of some systems; others are allocated."""
SMALL = 8
"""Size of arrays that always lie on the stack, from where LLVM takes them into registers."""


class LaneWriter:
    """Writes a lowered program in LLVM's language; it is a :class:`~rt_torchrl.programs.lowering.Writer`.

    ``body`` holds what every step computes, ``entry`` its memory, which ``exit`` frees. What is the same in all steps,
    LLVM computes once.

    Args:
        lanes: number of lanes and the source of their functions.
        prefix: prefix of global names.
    """

    def __init__(self, lanes: Lanes, prefix: str):
        self.lanes, self._prefix, n = lanes, prefix, lanes.number
        self.vector, self.mask = f"<{n} x double>", f"<{n} x i1>"
        self.entry: list[str] = []
        self.exit: list[str] = []
        self.body: list[str] = []
        self.globals: dict[str, str] = {}
        self._count = self._stack = 0

    def fresh(self) -> str:
        """A new name."""
        self._count += 1
        return f"%v{self._count}"

    def emit(self, text: str) -> str:
        """Write an instruction and give its result a name."""
        name = self.fresh()
        self.body.append(f"{name} = {text}")
        return name

    def constant(self, number: float, *, truth: bool) -> str:
        return f"splat (i1 {'true' if number else 'false'})" if truth else f"splat (double {_bits(number)})"

    def compute(self, name: str, *operands: str, truth: bool = False) -> str:
        types = {"number": self.vector, "truth": self.mask, "lanes": self.lanes.number}
        if name in FORMS:
            return self.emit(FORMS[name].llvm.format(*operands, **types))
        vector_function = symbol(name, self.lanes)
        if vector_function:
            return self._call(vector_function, self.vector, operands)
        result = "poison"
        for lane in range(self.lanes.number):
            given = [self.emit(f"extractelement {self.vector} {a}, i32 {lane}") for a in operands]
            one = self._call(name, "double", given)
            result = self.emit(f"insertelement {self.vector} {result}, double {one}, i32 {lane}")
        return result

    def _call(self, name: str, kind: str, operands: Sequence[str]) -> str:
        self.globals[name] = f"declare {kind} @{name}({', '.join([kind] * len(operands))}) {PURE}"
        return self.emit(f"call {kind} @{name}({', '.join(f'{kind} {a}' for a in operands)})")

    # Memory

    def table(self, numbers: Sequence[float]) -> str:
        name = f"@{self._prefix}.table{len(self.globals)}"
        values = ", ".join(f"double {_bits(x)}" for x in numbers)
        self.globals[name] = f"{name} = private constant [{len(numbers)} x double] [{values}]"
        return name

    def local(self, size: int) -> str:
        name, size_in_bytes = self.fresh(), 8 * size * self.lanes.number
        if size <= SMALL or self._stack + size_in_bytes <= STACK:
            self._stack += size_in_bytes
            self.entry.append(f"{name} = alloca [{size} x {self.vector}], align 64")
        else:
            self.globals["malloc"] = "declare noalias ptr @malloc(i64)"
            self.globals["free"] = "declare void @free(ptr)"
            self.entry.append(f"{name} = call ptr @malloc(i64 {size_in_bytes})")
            self.exit.append(f"call void @free(ptr {name})")
        return name

    def index(self, base: int, terms: Sequence[tuple[int, str]]) -> str:
        total = ""
        for stride, i in terms:
            term = i if stride == 1 else self.emit(f"mul nsw i64 {i}, {stride}")
            total = self.emit(f"add nsw i64 {total}, {term}") if total else term
        if not total:
            return str(base)
        return self.emit(f"add nsw i64 {total}, {base}") if base else total

    def load(self, array: str, index: str, *, shared: bool = False) -> str:
        element, known = ("double", ", !invariant.load !{}") if shared else (self.vector, "")
        place = self.emit(f"getelementptr {element}, ptr {array}, i64 {index}")
        found = self.emit(f"load {element}, ptr {place}, {WIDTH}{known}")
        return self._in_all("double", found) if shared else found

    def _in_all(self, kind: str, number: str) -> str:
        """A number in every lane."""
        n = self.lanes.number
        one = self.emit(f"insertelement <{n} x {kind}> poison, {kind} {number}, i32 0")
        return self.emit(f"shufflevector <{n} x {kind}> {one}, <{n} x {kind}> poison, <{n} x i32> zeroinitializer")

    def store(self, array: str, index: str, operand: str) -> None:
        place = self.emit(f"getelementptr {self.vector}, ptr {array}, i64 {index}")
        self.body.append(f"store {self.vector} {operand}, ptr {place}, {WIDTH}")

    def look_up(self, table: str, place: str, offset: int) -> str:
        n = self.lanes.number
        short = self.emit(f"fptosi {self.vector} {place} to <{n} x i32>")
        index = self.emit(f"sext <{n} x i32> {short} to <{n} x i64>")
        base = f"getelementptr (double, ptr {table}, i64 {offset})"
        return self._gathered(self.emit(f"getelementptr double, ptr {base}, <{n} x i64> {index}"))

    def _gathered(self, places: str) -> str:
        n = self.lanes.number
        given = f"<{n} x ptr> {places}, i32 8, {self.mask} splat (i1 true), {self.vector} poison"
        gather = f"llvm.masked.gather.v{n}f64.v{n}p0"
        self.globals[gather] = f"declare {self.vector} @{gather}(<{n} x ptr>, i32, {self.mask}, {self.vector})"
        return self.emit(f"call {self.vector} @{gather}({given})")

    # Loops

    @contextmanager
    def loop(self, count: int | str) -> Iterator[str]:
        slot, label = self.fresh(), self.fresh()[1:]
        self.entry.append(f"{slot} = alloca i64")
        self.body += [f"store i64 0, ptr {slot}", f"br label %{label}.in", f"{label}.in:"]
        index = self.emit(f"load i64, ptr {slot}")
        yield index
        following = self.emit(f"add nsw i64 {index}, 1")
        self.body.append(f"store i64 {following}, ptr {slot}")
        again = self.emit(f"icmp slt i64 {following}, {count}")
        self.body += [f"br i1 {again}, label %{label}.in, label %{label}.out", f"{label}.out:"]

    # Functions

    def inputs(self, sizes: dict[str, int], k: str) -> dict[tuple[str, int], str]:
        """Drive and state of interval k, see :func:`march_text`."""
        n, found = self.lanes.number, {("s", j): x for j, x in enumerate(self.row("%s", sizes["s"], k))}
        count, row = self._in_all("i64", "%last"), self.emit(f"add nsw i64 {k}, %row")
        lanes = f"<{n} x i64> <{', '.join(f'i64 {i}' for i in range(n))}>"
        lane = self.emit(f"add {lanes}, {self._in_all('i64', '%first')}")
        lane = self.emit(f"call <{n} x i64> @llvm.smin.v{n}i64(<{n} x i64> {lane}, <{n} x i64> {count})")
        for j in range(sizes["x"]):
            at = [self.emit(f"getelementptr i64, ptr %x, i64 {3 * j + i}") for i in range(3)]
            kinds = zip(("ptr", "i64", "i64"), at, strict=True)
            start, across, along = [self.emit(f"load {kind}, ptr {x}, !invariant.load !{{}}") for kind, x in kinds]
            here = self.emit(f"getelementptr i8, ptr {start}, i64 {self.emit(f'mul i64 {row}, {along}')}")
            distance = self.emit(f"mul <{n} x i64> {lane}, {self._in_all('i64', across)}")
            found["x", j] = self._gathered(self.emit(f"getelementptr i8, ptr {here}, <{n} x i64> {distance}"))
        return found

    def row(self, array: str, count: int, row: str) -> list[str]:
        """The operands in a row of an array of lanes."""
        return [self.load(array, self.index(j, [(count, row)])) for j in range(count)]

    def store_row(self, array: str, operands: Sequence[str], row: str) -> None:
        """Write operands into a row of an array of lanes."""
        for j, operand in enumerate(operands):
            self.store(array, self.index(j, [(len(operands), row)]), operand)

    def function(self, name: str, parameters: str) -> str:
        """The text of a function that computes the body."""
        head = f"define void @{name}({parameters}, i64 %n) {{"
        lines = [*self.globals.values(), head, "entry:", *self.entry, *self.body, *self.exit, "ret void", "}\n"]
        return "\n".join(lines)


def _bits(number: float) -> str:
    """A number in LLVM's language, to the bit."""
    return f"0x{struct.unpack('<Q', struct.pack('<d', number))[0]:016X}"


def march_text(program: Program, ends: Sequence[int], sizes: dict[str, int], lanes: Lanes) -> str:
    """A function ``march(x, first, last, row, s, w, n)``, which writes the states s[1] ... s[n] after s[0].

    ``s`` holds lanes, ``n+1 n_s lanes``, and ``w`` the weights. ``x`` has the address of every signal of the drive, and
    the bytes to the next realisation and to the next interval. The lanes are the realisations ``first`` to ``last``,
    which also fills the lanes that are left, and their drive begins with the interval ``row``.
    """
    writer = LaneWriter(lanes, "march")
    with writer.loop("%n") as k:
        inputs = writer.inputs(sizes, k)
        found = Lowering(program, writer, inputs, "%w").write(ends)
        writer.store_row("%s", found, writer.emit(f"add nsw i64 {k}, 1"))
    return writer.function("march", f"{DRIVE}, ptr noalias %s, ptr noalias %w")


def sweep_text(program: Program, outputs: Sequence[Sequence[int]], sizes: dict[str, int], lanes: Lanes) -> str:
    """A function ``sweep(x, first, last, row, s, source, stride, l, w, gx, gw, n)``, which goes back to interval 0.

    It adds the row k·stride of ``source`` (∂J/∂s_{k+1}) to the co-state ``l``, replaces this by the co-state at the
    start of the interval, writes the gradients by the interval's own inputs into ``gx`` and adds those by the weights
    to ``gw``. The outputs are these three, in this order.
    """
    writer = LaneWriter(lanes, "sweep")
    last = writer.emit("sub nsw i64 %n, 1")
    with writer.loop("%n") as i:
        k = writer.emit(f"sub nsw i64 {last}, {i}")
        inputs = writer.inputs(sizes, k)
        source = writer.row("%source", sizes["s"], writer.emit(f"mul nsw i64 {k}, %stride"))
        for j, pair in enumerate(zip(writer.row("%l", sizes["s"], "0"), source, strict=True)):
            inputs["l", j] = writer.compute("add", *pair)
        lowering = Lowering(program, writer, inputs, "%w")
        costates, driven, gradients = outputs
        lowering.write([*costates, *driven, *gradients])
        writer.store_row("%l", [*map(lowering.operand, costates)], "0")
        writer.store_row("%gx", [*map(lowering.operand, driven)], k)
        lowering.add_to("%gw", gradients)
    arrays = ", ".join(f"ptr noalias %{name}" for name in ("s", "source", "l", "w", "gx", "gw"))
    return writer.function("sweep", f"{DRIVE}, {arrays.replace('%source', '%source, i64 %stride')}")
