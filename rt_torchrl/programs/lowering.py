"""Lowering: a program becomes arithmetic, loads, stores and loops, which a writer puts into a language."""

import math
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from itertools import groupby
from typing import Protocol, runtime_checkable

from rt_torchrl.programs.program import ELEMENTWISE, Access, Program

BLOCKS = (8, 6, 5, 4, 3, 2, 1)
"""Numbers of columns of a product of matrices that are summed at once, so that a row is read once for all of them."""
SHORT = 16
"""Number of elements from which a run of gradients is added by a loop."""

Accesses = Sequence[Access | None]


@runtime_checkable
class Writer(Protocol):
    """A language for lowered programs. Operands, indices and arrays are texts of that language.

    An array that is ``shared`` holds one number for all lanes.
    """

    def constant(self, number: float, *, truth: bool) -> str: ...
    def compute(self, name: str, *operands: str, truth: bool = False) -> str: ...
    def table(self, numbers: Sequence[float]) -> str: ...
    def local(self, size: int) -> str: ...
    def index(self, base: int, terms: Sequence[tuple[int, str]]) -> str: ...
    def load(self, array: str, index: str, *, shared: bool = False) -> str: ...
    def store(self, array: str, index: str, operand: str) -> None: ...
    def look_up(self, array: str, place: str, offset: int, *, shared: bool) -> str: ...
    def loop(self, count: int) -> AbstractContextManager[str]: ...


class Lowering:
    """Writes the values of a program that its outputs need, in the order of their computation.

    Args:
        program: the program.
        writer: the language.
        inputs: operand of each input, by name and position.
        weights: array of the weights.
    """

    def __init__(self, program: Program, writer: Writer, inputs: dict[tuple[str, int], str], weights: str):
        self.program, self.writer, self._inputs, self._weights = program, writer, inputs, weights
        self._operands: dict[int, str] = {}
        self._arrays: dict[int, tuple[str, int, bool]] = {}  # name, offset, whether it is shared

    def write(self, outputs: Sequence[int]) -> list[str]:
        """Write everything that the outputs need, and give their operands."""
        for value in self.program.needed(outputs):
            if self.program.kinds[value] == "array":
                self._array(value)
            else:
                self._scalar(value)
        return [self.operand(value) for value in outputs]

    def operand(self, value: int) -> str:
        """The operand of a scalar value that has been written."""
        number = self.program.numbers.get(value)
        if number is not None:
            return self.writer.constant(number, truth=self.program.kinds[value] == "truth")
        return self._operands[value]

    def _scalar(self, value: int) -> None:
        p, writer, (name, operands, attributes) = self.program, self.writer, self.program.operations[value]
        if name == "constant":
            return
        if name == "input":
            operand = self._inputs[attributes]
        elif name == "element":
            operand = self._load(operands[0], attributes[0])
        elif name == "look_up":
            array, offset, shared = self._arrays[operands[0]]
            operand = writer.look_up(array, self.operand(operands[1]), offset + attributes[0], shared=shared)
        else:
            operand = writer.compute(name, *map(self.operand, operands), truth=p.kinds[value] == "truth")
        self._operands[value] = operand

    def _load(self, value: int, place: int, terms: Sequence[tuple[int, str]] = ()) -> str:
        """An element of an array that has been written."""
        array, offset, shared = self._arrays[value]
        return self.writer.load(array, self.writer.index(offset + place, terms), shared=shared)

    # Arrays, each kind by a method of its name

    def _array(self, value: int) -> None:
        name, operands, attributes = self.program.operations[value]
        if name == "weights":
            self._arrays[value] = (self._weights, attributes[0], True)
        elif name == "table":
            self._arrays[value] = (self.writer.table([float.fromhex(x) for x in attributes]), 0, True)
        else:
            array = self.writer.local(math.prod(attributes[0]))
            self._arrays[value] = (array, 0, False)
            getattr(self, f"_{name}")(array, operands, *attributes)

    def _row(self, array: str, operands: Sequence[int], dims: Sequence[int]) -> None:
        for i, a in enumerate(operands):
            self.writer.store(array, self.writer.index(i, ()), self.operand(a))

    def _map(self, array: str, operands: Sequence[int], dims: Sequence[int], name: str, accesses: Accesses) -> None:
        strides, body = [math.prod(dims[d + 1 :]) for d in range(len(dims))], Program()
        if all(access is None or list(access.strides) == strides for access in accesses):
            dims, strides = [math.prod(dims)], [1]  # all operands are walked through in order: one loop will do
            accesses = [access and Access(access.base, (1,)) for access in accesses]
        with self._loops(dims) as indices:
            read = {("x", k): self._read(*pair, indices) for k, pair in enumerate(zip(operands, accesses, strict=True))}
            value = ELEMENTWISE[name](body, *(body.new("input", attributes=key) for key in read))
            (result,) = Lowering(body, self.writer, read, "").write([body.as_number(value)])
            self.writer.store(array, self.writer.index(0, [*zip(strides, indices, strict=True)]), result)

    def _product(self, array: str, operands: Sequence[int], dims: Sequence[int], k: int, accesses: Accesses) -> None:
        (m, n), writer = dims, self.writer
        block = next(b for b in BLOCKS if n % b == 0)
        a, b, start = zip(operands, accesses, strict=True)
        totals = writer.local(block)
        with self._loops([m, n // block]) as (i, j):
            columns = [writer.index(c, [(block, j)]) for c in range(block)]
            for c, column in enumerate(columns):
                writer.store(totals, str(c), self._read(*start, [i, column]))
            with writer.loop(k) as at:
                x = self._read(*a, [i, at])
                for c, column in enumerate(columns):
                    product = writer.compute("mul", x, self._read(*b, [at, column]))
                    writer.store(totals, str(c), writer.compute("add", writer.load(totals, str(c)), product))
            for c, column in enumerate(columns):
                writer.store(array, writer.index(0, [(n, i), (1, column)]), writer.load(totals, str(c)))

    def _read(self, value: int, access: Access | None, indices: Sequence[str]) -> str:
        if access is None:
            return self.operand(value)
        terms = [(stride, i) for stride, i in zip(access.strides, indices, strict=True) if stride]
        return self._load(value, access.base, terms)

    @contextmanager
    def _loops(self, counts: Sequence[int]) -> Iterator[list[str]]:
        """Nested loops, with their indices."""
        with ExitStack() as loops:
            yield [loops.enter_context(self.writer.loop(count)) for count in counts]

    # Outputs

    def add_to(self, array: str, outputs: Sequence[int]) -> None:
        """Add outputs to the elements of an array that holds lanes; runs of elements of one array by a loop."""
        operations = [self.program.operations[value] for value in outputs]

        def run_of(j: int) -> tuple[object, ...]:
            name, operands, attributes = operations[j]
            return (operands, attributes[0] - j) if name == "element" else (j,)

        for _, run in groupby(range(len(outputs)), run_of):
            first, *rest = run
            if len(rest) >= SHORT:
                walk = Access(operations[first].attributes[0], (1,))
                with self.writer.loop(1 + len(rest)) as i:
                    operand = self._read(operations[first].operands[0], walk, [i])
                    self._add(array, self.writer.index(first, [(1, i)]), operand)
            else:
                for j in (first, *rest):
                    if self.program.numbers.get(outputs[j]) != 0.0:
                        self._add(array, self.writer.index(j, ()), self.operand(outputs[j]))

    def _add(self, array: str, index: str, operand: str) -> None:
        self.writer.store(array, index, self.writer.compute("add", self.writer.load(array, index), operand))
