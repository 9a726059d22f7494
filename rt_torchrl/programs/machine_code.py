"""Programs as LLVM's intermediate language, over lanes of realisations."""

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rt_torchrl.programs.lowering import Lowering
from rt_torchrl.programs.program import Program
from rt_torchrl.programs.vector_functions import FUNCTIONS, INTRINSICS, Lanes, symbol

INSTRUCTIONS = {
    **{name: f"f{name} contract {{number}} {{0}}, {{1}}" for name in ("add", "sub", "mul", "div")},
    **{name: f"{name} {{truth}} {{0}}, {{1}}" for name in ("and", "or", "xor")},
    "neg": "fneg {number} {0}",
    "not": "xor {truth} {0}, {true}",
    "compare": "fcmp {how} {number} {0}, {1}",
    "select": "select {truth} {0}, {number} {1}, {number} {2}",
}
"""Operations that are instructions, of numbers and of truth values. Products and sums may be contracted into one
rounding; nothing else of floating-point arithmetic is relaxed."""
WIDTH = "align 8"  # torch aligns rows to doubles
STACK = 2**17
"""Bytes of arrays that lie on the stack, which is 512 KiB in the threads of some systems; others are allocated."""


class LaneWriter:
    """Writes a lowered program in LLVM's language; it is a :class:`~rt_torchrl.programs.lowering.Writer`.

    ``prologue`` holds what is computed once, ``body`` what every step computes, ``entry`` the memory of both, which
    ``exit`` frees.

    Args:
        lanes: number of lanes and the source of their functions.
        prefix: prefix of global names.
    """

    def __init__(self, lanes: Lanes, prefix: str):
        self.lanes, self._prefix, n = lanes, prefix, lanes.number
        self.vector, self.mask = f"<{n} x double>", f"<{n} x i1>"
        self.entry: list[str] = []
        self.exit: list[str] = []
        self.prologue: list[str] = []
        self.body: list[str] = []
        self.globals: dict[str, str] = {}
        self.declarations: dict[str, str] = {}
        self._count = self._stack = 0
        self._places: dict[str, str] = {}

    def fresh(self) -> str:
        """A new name."""
        self._count += 1
        return f"%v{self._count}"

    def emit(self, text: str, *, once: bool = False) -> str:
        """Write an instruction and give its result a name."""
        name = self.fresh()
        (self.prologue if once else self.body).append(f"{name} = {text}")
        return name

    def constant(self, number: float, *, truth: bool, lanes: bool) -> str:
        text = (
            ("true" if number else "false") if truth else f"0x{struct.unpack('<Q', struct.pack('<d', number))[0]:016X}"
        )
        scalar = "i1" if truth else "double"
        return "<" + ", ".join([f"{scalar} {text}"] * self.lanes.number) + ">" if lanes else text

    def compute(self, name: str, operands: Sequence[str], how: str, *, truth: bool, lanes: bool) -> str:
        types = {"number": self.vector, "truth": self.mask} if lanes else {"number": "double", "truth": "i1"}
        if name in INSTRUCTIONS:
            true = self.constant(1.0, truth=True, lanes=lanes)
            return self.emit(INSTRUCTIONS[name].format(*operands, how=how, true=true, **types), once=not lanes)
        arguments = ", ".join(f"{types['number']} {a}" for a in operands)
        return self.emit(f"call {types['number']} @{self._function(name, lanes)}({arguments})", once=not lanes)

    def _function(self, name: str, lanes: bool) -> str:
        """The name of a mathematical function, which is declared; where there is none for lanes, one is defined."""
        number = self.vector if lanes else "double"
        if name in INTRINSICS:
            found = f"llvm.{INTRINSICS[name]}." + (f"v{self.lanes.number}f64" if lanes else "f64")
            self.declarations[found] = f"declare {number} @{found}({number})"
            return found
        arguments = ", ".join([number] * FUNCTIONS[name])
        found = (symbol(name, self.lanes) or f"lanes.{name}") if lanes else name
        self.declarations[found] = f"declare {number} @{found}({arguments})"
        if found.startswith("lanes."):
            self._function(name, False)
            self.declarations[found] = self._lane_by_lane(name, found)
        return found

    def _lane_by_lane(self, name: str, found: str) -> str:
        count = FUNCTIONS[name]
        lines, result = [], "poison"
        for lane in range(self.lanes.number):
            for a in range(count):
                lines.append(f"  %x{a}.{lane} = extractelement {self.vector} %x{a}, i32 {lane}")
            arguments = ", ".join(f"double %x{a}.{lane}" for a in range(count))
            lines.append(f"  %y{lane} = call double @{name}({arguments})")
            lines.append(f"  %r{lane} = insertelement {self.vector} {result}, double %y{lane}, i32 {lane}")
            result = f"%r{lane}"
        parameters = ", ".join(f"{self.vector} %x{a}" for a in range(count))
        text = "\n".join(lines)
        return f"define internal {self.vector} @{found}({parameters}) {{\n{text}\n  ret {self.vector} {result}\n}}"

    def spread(self, operand: str, *, truth: bool) -> str:
        return self._spread(operand, "i1" if truth else "double", once=True)

    def _spread(self, operand: str, scalar: str, *, once: bool) -> str:
        vector = f"<{self.lanes.number} x {scalar}>"
        one = self.emit(f"insertelement {vector} poison, {scalar} {operand}, i32 0", once=once)
        zeros = f"<{self.lanes.number} x i32> zeroinitializer"
        return self.emit(f"shufflevector {vector} {one}, {vector} poison, {zeros}", once=once)

    # Memory

    def table(self, numbers: Sequence[float]) -> str:
        name = f"@{self._prefix}.table{len(self.globals)}"
        values = ", ".join("double " + self.constant(x, truth=False, lanes=False) for x in numbers)
        self.globals[name] = f"{name} = private constant [{len(numbers)} x double] [{values}]"
        return name

    def local(self, size: int) -> str:
        name, size_in_bytes = self.fresh(), 8 * size * self.lanes.number
        if self._stack + size_in_bytes <= STACK:
            self._stack += size_in_bytes
            self.entry.append(f"{name} = alloca [{size} x {self.vector}], align 64")
        else:
            self.declarations["malloc"] = "declare noalias ptr @malloc(i64)"
            self.declarations["free"] = "declare void @free(ptr)"
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

    def load(self, array: str, index: str, *, lanes: bool, stored_lanes: bool) -> str:
        element = self.vector if stored_lanes else "double"
        place = self.emit(f"getelementptr {element}, ptr {array}, i64 {index}", once=not lanes)
        found = self.emit(f"load {element}, ptr {place}, {WIDTH}", once=not lanes)
        return self._spread(found, "double", once=False) if lanes and not stored_lanes else found

    def store(self, array: str, index: str, operand: str) -> None:
        place = self.emit(f"getelementptr {self.vector}, ptr {array}, i64 {index}")
        self.body.append(f"store {self.vector} {operand}, ptr {place}, {WIDTH}")

    def look_up(self, table: str, size: int, place: str, offset: int) -> str:
        n = self.lanes.number
        gather = f"llvm.masked.gather.v{n}f64.v{n}p0"
        self.declarations[gather] = f"declare {self.vector} @{gather}(<{n} x ptr>, i32, {self.mask}, {self.vector})"
        inside, index = self._place(size, place)
        base = f"getelementptr (double, ptr {table}, i64 {offset})"
        places = self.emit(f"getelementptr double, ptr {base}, <{n} x i64> {index}")
        nan = self.constant(float("nan"), truth=False, lanes=True)
        call = f"@{gather}(<{n} x ptr> {places}, i32 8, {self.mask} {inside}, {self.vector} {nan})"
        return self.emit(f"call {self.vector} {call}")

    def _place(self, size: int, place: str) -> tuple[str, str]:
        """Which lanes are inside a table, and their integer places; outside of it, and for NaN, a look-up is NaN."""
        n = self.lanes.number
        if f"{place}:{size}" not in self._places:
            zero, end = (self.constant(float(x), truth=False, lanes=True) for x in (0, size))
            low = self.emit(f"fcmp oge {self.vector} {place}, {zero}")
            inside = self.emit(f"and {self.mask} {low}, {self.emit(f'fcmp olt {self.vector} {place}, {end}')}")
            safe = self.emit(f"select {self.mask} {inside}, {self.vector} {place}, {self.vector} {zero}")
            short = self.emit(f"fptosi {self.vector} {safe} to <{n} x i32>")
            self._places[f"{place}:{size}"] = f"{inside} {self.emit(f'sext <{n} x i32> {short} to <{n} x i64>')}"
        inside, index = self._places[f"{place}:{size}"].split()
        return inside, index

    # Loops

    @contextmanager
    def loop(self, count: int) -> Iterator[str]:
        slot, label = self.fresh(), self.fresh()[1:]
        self.entry.append(f"{slot} = alloca i64")
        self.body += [f"store i64 0, ptr {slot}", f"br label %{label}.in", f"{label}.in:"]
        index = self.emit(f"load i64, ptr {slot}")
        yield index
        following = self.emit(f"add nsw i64 {index}, 1")
        self.body.append(f"store i64 {following}, ptr {slot}")
        again = self.emit(f"icmp slt i64 {following}, {count}")
        self.body += [f"br i1 {again}, label %{label}.in, label %{label}.out", f"{label}.out:"]

    def variable(self, start: str) -> str:
        slot = self.fresh()
        self.entry.append(f"{slot} = alloca {self.vector}, align 64")
        self.put(slot, start)
        return slot

    def get(self, variable: str) -> str:
        return self.emit(f"load {self.vector}, ptr {variable}")

    def put(self, variable: str, operand: str) -> None:
        self.body.append(f"store {self.vector} {operand}, ptr {variable}")


def march_text(program: Program, ends: Sequence[int], sizes: dict[str, int], lanes: Lanes) -> str:
    """A function ``march(x, s, w, n)``, which writes the states s[1] ... s[n] after s[0].

    Arrays hold lanes: ``x`` is ``n n_x lanes``, ``s`` is ``n+1 n_s lanes``; ``w`` holds the weights.
    """

    def body(writer: LaneWriter) -> None:
        inputs = _loaded(writer, "x", "%x", sizes["x"], "%k") | _loaded(writer, "s", "%s", sizes["s"], "%k")
        lowering = Lowering(program, writer, inputs, "%w")
        lowering.write(ends)
        following = writer.emit("add nsw i64 %k, 1")
        _stored(writer, lowering, ends, "%s", following)

    return _function("march", "ptr noalias %x, ptr noalias %s, ptr noalias %w", body, lanes, backwards=False)


def sweep_text(
    program: Program,
    costates: Sequence[int],
    gradients: Sequence[int],
    driven: Sequence[int],
    sizes: dict[str, int],
    lanes: Lanes,
) -> str:
    """A function ``sweep(x, s, source, stride, l, w, gx, gw, n)``, which goes back from interval n − 1 to 0.

    It adds the row k·stride of ``source`` (∂J/∂s_{k+1}) to the co-state ``l``, replaces this by the co-state at the
    start of the interval, writes the gradients by the interval's own inputs into ``gx`` and adds those by the weights
    to ``gw``.
    """

    def body(writer: LaneWriter) -> None:
        inputs = _loaded(writer, "x", "%x", sizes["x"], "%k") | _loaded(writer, "s", "%s", sizes["s"], "%k")
        costate = _loaded(writer, "l", "%l", sizes["s"], "0")
        at = writer.emit("mul nsw i64 %k, %stride")
        source = _loaded(writer, "l", "%source", sizes["s"], at)
        for key, held in costate.items():
            inputs[key] = writer.compute("add", [held, source[key]], "", truth=False, lanes=True)
        lowering = Lowering(program, writer, inputs, "%w")
        lowering.write([*costates, *driven, *gradients])
        _stored(writer, lowering, costates, "%l", "0")
        _stored(writer, lowering, driven, "%gx", "%k")
        lowering.add_to("%gw", gradients)

    pointers = ", ".join(f"ptr noalias %{name}" for name in ("x", "s", "source", "l", "w", "gx", "gw"))
    parameters = pointers.replace("ptr noalias %l", "i64 %stride, ptr noalias %l")
    return _function("sweep", parameters, body, lanes, backwards=True)


def _loaded(writer: LaneWriter, name: str, array: str, count: int, row: str) -> dict[tuple[str, int], str]:
    """Operands of the row of an array that holds lanes."""
    found = {}
    for j in range(count):
        index = writer.index(j, [(count, row)])
        found[name, j] = writer.load(array, index, lanes=True, stored_lanes=True)
    return found


def _stored(writer: LaneWriter, lowering: Lowering, outputs: Sequence[int], array: str, row: str) -> None:
    for j, value in enumerate(outputs):
        writer.store(array, writer.index(j, [(len(outputs), row)]), lowering.operand(value))


def _function(name: str, parameters: str, write: Callable[[LaneWriter], None], lanes: Lanes, *, backwards: bool) -> str:
    """The text of a function that repeats a body for every interval k."""
    writer = LaneWriter(lanes, name)
    write(writer)
    step = "%k = sub nsw i64 %last, %i" if backwards else "%k = add nsw i64 %i, 0"
    head = [
        "%last = sub nsw i64 %n, 1",
        "br label %top",
        "top:",
        "%i = phi i64 [ 0, %entry ], [ %next, %bottom ]",
        step,
    ]
    tail = ["br label %bottom", "bottom:", "%next = add nsw i64 %i, 1", "%more = icmp slt i64 %next, %n"]
    tail += ["br i1 %more, label %top, label %done", "done:", *writer.exit, "ret void"]
    lines = [*writer.entry, *writer.prologue, *head, *writer.body, *tail]
    text = "\n".join(line if line.endswith(":") else f"  {line}" for line in lines)
    globals_ = "\n".join([*writer.globals.values(), *writer.declarations.values()])
    return f"{globals_}\ndefine void @{name}({parameters}, i64 %n) {{\nentry:\n{text}\n}}\n"
