"""Programs as machine code over lanes of realisations: LLVM's intermediate language, compiled and loaded."""

import ctypes
import ctypes.util
import hashlib
import platform
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import llvmlite.binding as llvm
import numpy as np
from platformdirs import user_cache_path

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.programs.lowering import Lowering
from rt_torchrl.programs.program import ARITHMETIC, C_NAMES, COMPARISONS, EXTREMES, FUNCTIONS, ROUNDED, Program

PURE = "memory(none) nounwind willreturn speculatable"
"""Attributes of mathematical functions, by which LLVM computes once what is the same in all steps."""
WIDTH = "align 8"  # torch aligns rows to doubles
STACK = 2**17
"""Bytes of arrays that lie on the stack, which is 512 KiB in the threads of some systems; others are allocated."""
SMALL = 8
"""Size of arrays that always lie on the stack, from where LLVM takes them into registers."""
X = "ptr noalias %x, i64 %first, i64 %last"
"""Parameters of functions that read a drive, see :func:`march_text`."""
OPTIMISATION, LONG = 2, 20_000
"""Level at which LLVM optimises, and number of lines of a text beyond which it takes the code as it was written: its
passes take minutes there, and save a tenth of the time of a run."""
DIGEST = hashlib.sha256().digest_size
_memory_of = (ctypes.c_char * 0).from_buffer  # four times faster than the array's own address
FORMS = {
    **{name: f"f{name} contract {{number}} {{0}}, {{1}}" for name in ARITHMETIC},
    **{name: f"fcmp {'une' if name == 'ne' else 'o' + name} {{number}} {{0}}, {{1}}" for name in COMPARISONS},
    **{name: f"{name} {{truth}} {{0}}, {{1}}" for name in ("and", "or", "xor")},
    **{name: f"call {{number}} @llvm.{C_NAMES.get(name, name)}.v{{lanes}}f64({{number}} {{0}})" for name in ROUNDED},
    **{
        name: f"call nsz {{number}} @llvm.{name}.v{{lanes}}f64({{number}} {{0}}, {{number}} {{1}})" for name in EXTREMES
    },
    "neg": "fneg {number} {0}",
    "not": "xor {truth} {0}, splat (i1 true)",
    "select": "select {truth} {0}, {number} {1}, {number} {2}",
}
"""Operations that are instructions, with their operands in braces; ``number`` and ``truth`` are the types of lanes,
``lanes`` is their number. Products and sums may be contracted into one rounding; nothing else of floating-point
arithmetic is relaxed."""


class Lanes(NamedTuple):
    """The lanes of a processor.

    Args:
        number: number of doubles that are computed at once.
        variant: letter of the C library's vector functions for these lanes (glibc's vector ABI); empty for none.
    """

    number: int
    variant: str


@cache
def lanes_of_this_machine() -> Lanes:
    """The widest lanes of this processor: AVX-512, AVX2, or 128 bits (SSE2, NEON)."""
    features = llvm.get_host_cpu_features()
    if platform.machine().lower() in ("aarch64", "arm64"):
        return Lanes(2, "n")
    if features.get("avx512f") and features.get("avx512dq"):
        return Lanes(8, "e")
    if features.get("avx2") and features.get("fma"):
        return Lanes(4, "d")
    return Lanes(2, "b")


@cache
def symbol(name: str, lanes: Lanes) -> str | None:
    """The C library's vector function for these lanes; None where the library has none."""
    load_functions()
    mangled = f"_ZGV{lanes.variant}N{lanes.number}{'v' * FUNCTIONS[name]}_{name}"
    return mangled if lanes.variant and llvm.address_of_symbol(mangled) else None


@cache
def load_functions() -> None:
    """Make the C library's functions known to LLVM, of one number and, where it has them, of vectors."""
    llvm.load_library_permanently("ucrtbase" if sys.platform == "win32" else ctypes.util.find_library("m"))
    with suppress(RuntimeError):
        llvm.load_library_permanently("libmvec.so.1")  # of glibc 2.22, with all functions since 2.35


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
            return self.emit(FORMS[name].format(*operands, **types))
        vector_function = symbol(name, self.lanes)
        if vector_function:
            return self._call(vector_function, self.vector, operands)
        result = "poison"
        for lane in range(self.lanes.number):
            arguments = [self.emit(f"extractelement {self.vector} {a}, i32 {lane}") for a in operands]
            element = self._call(name, "double", arguments)
            result = self.emit(f"insertelement {self.vector} {result}, double {element}, i32 {lane}")
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
        element, metadata = ("double", ", !invariant.load !{}") if shared else (self.vector, "")
        place = self.emit(f"getelementptr {element}, ptr {array}, i64 {index}")
        value = self.emit(f"load {element}, ptr {place}, {WIDTH}{metadata}")
        return self._in_all("double", value) if shared else value

    def _in_all(self, kind: str, number: str) -> str:
        """A number in every lane."""
        n = self.lanes.number
        first = self.emit(f"insertelement <{n} x {kind}> poison, {kind} {number}, i32 0")
        return self.emit(f"shufflevector <{n} x {kind}> {first}, <{n} x {kind}> poison, <{n} x i32> zeroinitializer")

    def store(self, array: str, index: str, operand: str) -> None:
        place = self.emit(f"getelementptr {self.vector}, ptr {array}, i64 {index}")
        self.body.append(f"store {self.vector} {operand}, ptr {place}, {WIDTH}")

    def look_up(self, array: str, place: str, offset: int, *, shared: bool) -> str:
        n = self.lanes.number
        short = self.emit(f"fptosi {self.vector} {place} to <{n} x i32>")
        index = self.emit(f"sext <{n} x i32> {short} to <{n} x i64>")
        if not shared:  # each lane has elements of its own
            index = self.emit(f"mul nsw <{n} x i64> {index}, {self._in_all('i64', str(n))}")
            index = self.emit(f"add nsw <{n} x i64> {index}, {self._numbers()}")
            offset *= n
        base = self.emit(f"getelementptr double, ptr {array}, i64 {offset}")
        return self._gathered(self.emit(f"getelementptr double, ptr {base}, <{n} x i64> {index}"))

    def _numbers(self) -> str:
        """The numbers of the lanes."""
        return f"<{', '.join(f'i64 {lane}' for lane in range(self.lanes.number))}>"

    def _gathered(self, places: str) -> str:
        n = self.lanes.number
        arguments = f"<{n} x ptr> {places}, i32 8, {self.mask} splat (i1 true), {self.vector} poison"
        gather = f"llvm.masked.gather.v{n}f64.v{n}p0"
        self.globals[gather] = f"declare {self.vector} @{gather}(<{n} x ptr>, i32, {self.mask}, {self.vector})"
        return self.emit(f"call {self.vector} @{gather}({arguments})")

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
        n, inputs = self.lanes.number, {("s", j): x for j, x in enumerate(self.row("%s", sizes["s"], k))}
        count = self._in_all("i64", "%last")
        lane = self.emit(f"add <{n} x i64> {self._numbers()}, {self._in_all('i64', '%first')}")
        lane = self.emit(f"call <{n} x i64> @llvm.smin.v{n}i64(<{n} x i64> {lane}, <{n} x i64> {count})")
        for j in range(sizes["x"]):
            at = [self.emit(f"getelementptr i64, ptr %x, i64 {3 * j + i}") for i in range(3)]
            kinds = zip(("ptr", "i64", "i64"), at, strict=True)
            start, across, along = [self.emit(f"load {kind}, ptr {x}, !invariant.load !{{}}") for kind, x in kinds]
            address = self.emit(f"getelementptr i8, ptr {start}, i64 {self.emit(f'mul i64 {k}, {along}')}")
            distance = self.emit(f"mul <{n} x i64> {lane}, {self._in_all('i64', across)}")
            inputs["x", j] = self._gathered(self.emit(f"getelementptr i8, ptr {address}, <{n} x i64> {distance}"))
        return inputs

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
    """A function ``march(x, first, last, s, w, n)``, which writes the states s[1] ... s[n] after s[0].

    ``s`` holds lanes, ``n+1 n_s lanes``, and ``w`` the weights. ``x`` has the address of every signal of the drive, and
    the bytes to the next realisation and to the next interval. The lanes are the realisations ``first`` to ``last``,
    which also fills the lanes that are left.
    """
    writer = LaneWriter(lanes, "march")
    with writer.loop("%n") as k:
        inputs = writer.inputs(sizes, k)
        operands = Lowering(program, writer, inputs, "%w").write(ends)
        writer.store_row("%s", operands, writer.emit(f"add nsw i64 {k}, 1"))
    return writer.function("march", f"{X}, ptr noalias %s, ptr noalias %w")


def sweep_text(program: Program, outputs: Sequence[Sequence[int]], sizes: dict[str, int], lanes: Lanes) -> str:
    """A function ``sweep(x, first, last, s, source, stride, l, w, gx, gw, n)``, which goes back to interval 0.

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
    return writer.function("sweep", f"{X}, {arrays.replace('%source', '%source, i64 %stride')}")


class ObjectCode:
    """A function of machine code, which stays loaded as long as this object lives.

    Args:
        text: LLVM's text of a module.
        name: name of the function.
        arguments: types of the arguments of the function.
    """

    def __init__(self, text: str, name: str, arguments: tuple[type, ...]):
        load_functions()
        code = llvm.ObjectFileRef.from_data(_compiled(text))
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
        self._engine.add_object_file(code)
        self._engine.finalize_object()
        self._function = ctypes.CFUNCTYPE(None, *arguments)(self._engine.get_function_address(name))

    def __call__(self, *arguments: np.ndarray | int) -> None:
        """Run the function; of an array, whose numbers lie side by side, it gets the address."""
        self.bound(*arguments)()

    def bound(self, *arguments: np.ndarray | int) -> Callable[[], None]:
        """The call with these arrays, whose numbers may change between calls; it keeps their memory alive."""
        return partial(self._function, *(x if isinstance(x, int) else _memory_of(x.data) for x in arguments))


def _compiled(text: str) -> bytes:
    """Object code of a text: from the disk, where its name is the digest of everything it depends on, or made anew.

    A file begins with the digest of its code; one that is damaged is made again.
    """
    identity = (text, llvm.llvm_version_info, version("llvmlite"), llvm.get_host_cpu_name(), _features(), OPTIMISATION)
    path = cache_folder() / f"{hashlib.sha256(repr(identity).encode()).hexdigest()}.o"
    try:
        cached = path.read_bytes()
    except OSError:
        cached = b""
    if cached and hashlib.sha256(cached[DIGEST:]).digest() == cached[:DIGEST]:
        return cached[DIGEST:]
    code = _compile(text)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, hashlib.sha256(code).digest() + code)
    except OSError:
        pass  # where nothing can be kept, the next process compiles again
    return code


def cache_folder() -> Path:
    """The folder of object code in the user's cache."""
    return user_cache_path("rt_torchrl") / "native"


def _compile(text: str) -> bytes:
    level = OPTIMISATION if text.count("\n") <= LONG else 1
    machine = _machine(level)
    module = llvm.parse_assembly(text)
    module.verify()
    if level == OPTIMISATION:
        options = llvm.create_pipeline_tuning_options(speed_level=level)
        options.slp_vectorization = options.loop_vectorization = False  # the lanes are the vectors
        passes = llvm.create_pass_builder(machine, options)
        passes.getModulePassManager().run(module, passes)
    return bytes(machine.emit_object(module))


def _machine(level: int = OPTIMISATION) -> llvm.TargetMachine:
    """A new description of this processor, because the code that is loaded with one frees it."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=_features(), opt=level, jit=True)


@cache
def _features() -> str:
    return str(llvm.get_host_cpu_features().flatten())
