"""Programs of scalar operations: values in the order of their computation, folded and shared."""

import math
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

Kind = Literal["number", "truth", "array"]
CONSTANT, UNIFORM, VARYING = 0, 1, 2
"""Levels of a value: known when the program is made, the same for all lanes and steps, or neither."""

UNARY = frozenset(
    "exp exp2 expm1 log log1p log2 log10 sin cos tan tanh sinh cosh asin acos atan asinh acosh atanh erf sqrt floor "
    "ceil trunc round abs neg erfc".split()
)
COMPARISONS = {"gt": "ogt", "lt": "olt", "ge": "oge", "le": "ole", "eq": "oeq", "ne": "une"}
"""Comparisons of torch, by the names that LLVM gives to comparisons of numbers: NaN is unequal to everything."""
LEAST_DIVISOR = 2.0**-1022
"""Least divisor whose reciprocal is finite."""
HIGHEST_POWER = 8
"""Greatest integer exponent of a power that becomes a product."""


class UntraceableError(ValueError):
    """Code that cannot become a program; the message says why and where."""


class Operation(NamedTuple):
    """One operation on earlier values, with attributes that are known when the program is made."""

    name: str
    operands: tuple[int, ...] = ()
    attributes: tuple[Any, ...] = ()


class Access(NamedTuple):
    """How a loop reads an operand: the element ``base + Σ strides·indices`` of an array, or one scalar for all."""

    base: int
    strides: tuple[int, ...]

    @classmethod
    def over(cls, places: Tensor) -> "Access | None":
        """The way to walk through places on an even grid; None if they are on no such grid."""
        base = int(places.flatten()[0])
        firsts = [int(places.movedim(d, 0)[1].flatten()[0]) if n > 1 else base for d, n in enumerate(places.shape)]
        grid, strides = torch.tensor(base), tuple(first - base for first in firsts)
        for d, (n, stride) in enumerate(zip(places.shape, strides, strict=True)):
            grid = grid + (torch.arange(n) * stride).view([-1 if e == d else 1 for e in range(places.ndim)])
        return cls(base, strides) if torch.equal(grid.expand(places.shape), places) else None


class Program:
    """Values of scalar and array operations; equal operations are one value, and constants are folded.

    An array operation stands for a loop: ``map`` (elementwise), ``product`` (of two matrices), ``row`` (of scalars),
    ``table`` (of constants), ``weights``. ``element`` reads one of its elements, ``look_up`` one at a place that is
    computed.
    """

    def __init__(self) -> None:
        self.operations: list[Operation] = []
        self.kinds: list[Kind] = []
        self.levels: list[int] = []
        self.differentiating = False
        """While co-states are traced, 0·x is zero: a value that the result does not depend on has no derivative. In
        the trajectory itself 0·x stays, because x may be infinite or NaN."""
        self._numbers: dict[int, float] = {}
        self._known: dict[Operation, int] = {}

    def new(
        self, name: str, *operands: int, attributes: tuple[Any, ...] = (), kind: Kind = "number", level: int = 0
    ) -> int:
        """The value of an operation, which is made unless it exists; its level is at least that of its operands."""
        operation = Operation(name, operands, attributes)
        if operation not in self._known:
            self._known[operation] = len(self.operations)
            self.operations.append(operation)
            self.kinds.append(kind)
            self.levels.append(max(level, *(self.levels[a] for a in operands)) if operands else level)
        return self._known[operation]

    def constant(self, value: int | float) -> int:
        """A number or a truth value that is known."""
        kind: Kind = "truth" if isinstance(value, bool) else "number"
        found = self.new("constant", attributes=(kind, float(value).hex()), kind=kind)
        self._numbers[found] = float(value)
        return found

    def number(self, value: int) -> float | None:
        """The number that a value is known to have; None if it is computed later."""
        return self._numbers.get(value)

    def needed(self, outputs: Iterable[int]) -> list[int]:
        """The values that the outputs depend on, in the order of their computation."""
        found: set[int] = set()
        stack = list(outputs)
        while stack:
            value = stack.pop()
            if value not in found:
                found.add(value)
                stack += self.operations[value].operands
        return sorted(found)

    # Truth values

    def as_number(self, a: int) -> int:
        return self.select(a, self.constant(1.0), self.constant(0.0)) if self.kinds[a] == "truth" else a

    def as_truth(self, a: int) -> int:
        return a if self.kinds[a] == "truth" else self.compare("une", a, self.constant(0.0))

    def compare(self, how: str, a: int, b: int) -> int:
        a, b = self.as_number(a), self.as_number(b)
        x, y = self.number(a), self.number(b)
        if x is not None and y is not None:
            results = {"ogt": x > y, "olt": x < y, "oge": x >= y, "ole": x <= y, "oeq": x == y, "une": x != y}
            return self.constant(results[how])
        return self.new("compare", a, b, attributes=(how,), kind="truth")

    def select(self, condition: int, a: int, b: int) -> int:
        condition = self.as_truth(condition)
        if self.kinds[a] != self.kinds[b]:
            a, b = self.as_number(a), self.as_number(b)
        known = self.number(condition)
        if known is not None:
            return a if known else b
        if a == b:
            return a
        if self.kinds[a] == "truth":
            inverse = self.logic("not", condition)
            return self.logic("or", self.logic("and", condition, a), self.logic("and", inverse, b))
        return self.new("select", condition, a, b)

    def logic(self, how: str, *operands: int) -> int:
        a, *rest = (self.as_truth(x) for x in operands)
        if how == "not":
            known = self.number(a)
            return self.constant(not known) if known is not None else self.new("not", a, kind="truth")
        (b,) = rest
        for known, other in ((self.number(a), b), (self.number(b), a)):
            if known is None:
                continue
            if how == "xor":
                return self.logic("not", other) if known else other
            absorbs = known == (how == "or")
            return self.constant(bool(known)) if absorbs else other
        return a if a == b and how != "xor" else self.new(how, *sorted((a, b)), kind="truth")

    # Arithmetic

    def neg(self, a: int) -> int:
        a = self.as_number(a)
        x = self.number(a)
        if x is not None:
            return self.constant(-x)
        operation = self.operations[a]
        return operation.operands[0] if operation.name == "neg" else self.new("neg", a)

    def add(self, a: int, b: int) -> int:
        a, b = self.as_number(a), self.as_number(b)
        x, y = self.number(a), self.number(b)
        if x is not None and y is not None:
            return self.constant(x + y)
        for zero, other in ((x, b), (y, a)):
            if zero == 0.0 and (self.differentiating or math.copysign(1.0, zero) < 0.0):  # −0 + 0 is 0
                return other
        for negated, other in ((b, a), (a, b)):
            if self.operations[negated].name == "neg":
                return self.sub(other, self.operations[negated].operands[0])
        return self.new("add", *sorted((a, b)))

    def sub(self, a: int, b: int) -> int:
        a, b = self.as_number(a), self.as_number(b)
        x, y = self.number(a), self.number(b)
        if x is not None and y is not None:
            return self.constant(x - y)
        if y == 0.0 and (self.differentiating or math.copysign(1.0, y) > 0.0):
            return a
        if x == 0.0 and (self.differentiating or math.copysign(1.0, x) < 0.0):  # 0 − 0 is 0, and not −0
            return self.neg(b)
        if self.operations[b].name == "neg":
            return self.add(a, self.operations[b].operands[0])
        return self.new("sub", a, b)

    def mul(self, a: int, b: int) -> int:
        a, b = sorted((self.as_number(a), self.as_number(b)), key=lambda v: (self.number(v) is None, v))
        x, y = self.number(a), self.number(b)
        if x is not None and y is not None:
            return self.constant(x * y)
        if x == 0.0 and self.differentiating:
            return a
        if x == 1.0:
            return b
        if x == -1.0:
            return self.neg(b)
        for negated, other in ((a, b), (b, a)):
            if self.operations[negated].name == "neg":
                return self.neg(self.mul(self.operations[negated].operands[0], other))
        return self.new("mul", a, b)

    def div(self, a: int, b: int) -> int:
        a, b = self.as_number(a), self.as_number(b)
        x, y = self.number(a), self.number(b)
        if x is not None and y is not None and y != 0.0:
            return self.constant(x / y)
        if x == 0.0 and self.differentiating:
            return a
        if (
            y is not None and abs(math.frexp(y)[0]) == 0.5 and abs(y) >= LEAST_DIVISOR
        ):  # the reciprocal of a power of two is exact
            return self.mul(a, self.constant(1.0 / y))
        return self.new("div", a, b)

    def pow(self, a: int, b: int) -> int:
        a, b = self.as_number(a), self.as_number(b)
        y = self.number(b)
        one = self.constant(1.0)
        if y is not None and abs(y) == 0.5:
            root = self.unary("sqrt", a)
            return root if y > 0 else self.div(one, root)
        if y is not None and abs(y) <= HIGHEST_POWER and y == int(y):
            if y == 0.0:
                return one
            product = self._integer_power(a, int(abs(y)))
            return product if y > 0 else self.div(one, product)
        return self.binary("pow", a, b)

    def _integer_power(self, a: int, exponent: int) -> int:
        if exponent == 1:
            return a
        half = self._integer_power(a, exponent // 2)
        square = self.mul(half, half)
        return self.mul(square, a) if exponent % 2 else square

    def unary(self, name: str, a: int) -> int:
        a = self.as_number(a)
        if name == "neg":
            return self.neg(a)
        x = self.number(a)
        if x is not None:
            return self.constant(float(getattr(torch, name)(torch.tensor(x, dtype=torch.float64))))
        return self.new(name, a)

    def binary(self, name: str, a: int, b: int) -> int:
        """A mathematical function of two numbers."""
        a, b = self.as_number(a), self.as_number(b)
        x, y = (None if v is None else torch.tensor(v, dtype=torch.float64) for v in (self.number(a), self.number(b)))
        return self.new(name, a, b) if x is None or y is None else self.constant(float(getattr(torch, name)(x, y)))

    def extreme(self, name: str, a: int, b: int) -> int:
        """Minimum or maximum; NaN if one of the two is NaN."""
        a, b = self.as_number(a), self.as_number(b)
        how = "olt" if name == "minimum" else "ogt"
        if self.number(b) is not None:
            a, b = b, a
        if self.number(a) != self.number(a):
            return a
        if self.number(a) is not None:  # where b is NaN the comparison fails and b is chosen
            return self.select(self.compare(how, a, b), a, b)
        return self.select(self.logic("or", self.compare(how, a, b), self.compare("une", a, a)), a, b)
