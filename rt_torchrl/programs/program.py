"""Programs of scalar operations: values in the order of their computation, folded and shared."""

import math
from collections.abc import Callable, Iterable
from functools import partial, reduce
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

ARITHMETIC = ("add", "sub", "mul", "div")
COMPARISONS = ("gt", "lt", "ge", "le", "eq", "ne")
"""Comparisons, of which NaN makes all false but the last one."""
ROUNDED = ("sqrt", "floor", "ceil", "trunc", "round", "abs")
"""Functions that are instructions of most processors; halves are rounded to even."""
C_NAMES = {"abs": "fabs", "round": "rint"}
"""Names of these in LLVM and in the C library that are not torch's."""
EXTREMES = ("minimum", "maximum")
"""Extremes, which are NaN if one of the two is NaN."""
FUNCTIONS = {
    **dict.fromkeys("exp exp2 expm1 log log1p log2 log10 sin cos tan tanh sinh cosh asin acos atan".split(), 1),
    **dict.fromkeys("asinh acosh atanh erf erfc".split(), 1),
    **dict.fromkeys("pow atan2 hypot fmod".split(), 2),
}
"""Functions of the C library, under its names and torch's, and the numbers of their arguments."""
Kind = Literal["number", "truth", "array"]
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
        neighbours = [int(places.movedim(d, 0)[1].flatten()[0]) if n > 1 else base for d, n in enumerate(places.shape)]
        strides = tuple(neighbour - base for neighbour in neighbours)
        last = base + sum((n - 1) * stride for n, stride in zip(places.shape, strides, strict=True))
        if min(strides, default=0) < 0:
            return None
        grid = torch.arange(last + 1).as_strided(places.shape, strides, base)
        return cls(base, strides) if torch.equal(grid, places) else None


class Program:
    """Values of scalar and array operations; equal operations are one value, and constants are folded.

    An array operation stands for a loop: ``map`` (elementwise), ``product`` (of two matrices), ``row`` (of scalars),
    ``table`` (of constants), ``weights``. ``element`` reads one of its elements, ``look_up`` one at a place that is
    computed.
    """

    def __init__(self) -> None:
        self.operations: list[Operation] = []
        self.kinds: list[Kind] = []
        self.differentiating = False
        """While co-states are traced, 0·x is zero: a value that the result does not depend on has no derivative. In
        the trajectory itself 0·x stays, because x may be infinite or NaN."""
        self.numbers: dict[int, float] = {}
        """The values that are known when the program is made."""
        self._known: dict[Operation, int] = {}

    def new(self, name: str, *operands: int, attributes: tuple[Any, ...] = (), kind: Kind = "number") -> int:
        """The value of an operation, which is made unless it exists."""
        operation = Operation(name, operands, attributes)
        if operation not in self._known:
            self._known[operation] = len(self.operations)
            self.operations.append(operation)
            self.kinds.append(kind)
        return self._known[operation]

    def constant(self, value: int | float) -> int:
        """A number or a truth value that is known."""
        kind: Kind = "truth" if isinstance(value, bool) else "number"
        constant = self.new("constant", attributes=(kind, float(value).hex()), kind=kind)
        self.numbers[constant] = float(value)
        return constant

    def needed(self, outputs: Iterable[int]) -> list[int]:
        """The values that the outputs depend on, in the order of their computation."""
        needed = set(outputs)
        for value in range(max(needed, default=-1), -1, -1):  # operands come before what is made of them
            if value in needed:
                needed.update(self.operations[value].operands)
        return sorted(needed)

    # Truth values

    def as_number(self, a: int) -> int:
        return self.select(a, self.constant(1.0), self.constant(0.0)) if self.kinds[a] == "truth" else a

    def as_truth(self, a: int) -> int:
        return a if self.kinds[a] == "truth" else self.apply("ne", a, self.constant(0.0))

    def select(self, condition: int, a: int, b: int) -> int:
        condition = self.as_truth(condition)
        if self.kinds[a] != self.kinds[b]:
            a, b = self.as_number(a), self.as_number(b)
        known = self.numbers.get(condition)
        if known is not None:
            return a if known else b
        if a == b:
            return a
        if self.kinds[a] == "truth":
            return self.as_truth(self.select(condition, self.as_number(a), self.as_number(b)))
        return self.new("select", condition, a, b)

    def logic(self, how: str, *operands: int) -> int:
        """``and``, ``or``, ``xor`` or ``not``."""
        truths = [self.as_truth(a) for a in operands]
        known = [self.numbers.get(a) for a in truths]
        if None not in known:
            return self.constant(getattr(torch, f"logical_{how}")(*map(torch.tensor, known)).item())
        if (how == "and" and 0.0 in known) or (how == "or" and 1.0 in known):
            return self.constant(how == "or")
        return self.new(how, *sorted(truths), kind="truth")

    # Arithmetic

    def apply(self, name: str, *operands: int) -> int:
        """A function of numbers, by torch's name: what it is known to be, something simpler, or a new operation."""
        numbers = [self.as_number(a) for a in operands]
        known = [self.numbers.get(a) for a in numbers]
        constants = [torch.tensor(x, dtype=torch.float64) for x in known if x is not None]
        if len(constants) == len(known):
            return self.constant(getattr(torch, name)(*constants).item())
        kind: Kind = "truth" if name in COMPARISONS else "number"
        simplified: Callable[..., int] | None = getattr(self, f"_{name}", None)  # of add, sub, mul, div and pow
        return simplified(*numbers) if simplified else self.new(name, *numbers, kind=kind)

    def _is_nothing(self, a: int, *, subtracted: bool = False) -> bool:
        """Whether a value is a zero that a sum does not need: 0 − 0 is 0, but −0 + 0 is not −0."""
        x = self.numbers.get(a)
        return x == 0.0 and (self.differentiating or (math.copysign(1.0, x) > 0.0) == subtracted)

    def _add(self, a: int, b: int) -> int:
        if self._is_nothing(a) or self._is_nothing(b):
            return b if self._is_nothing(a) else a
        return self.new("add", *sorted((a, b)))

    def _sub(self, a: int, b: int) -> int:
        if self._is_nothing(b, subtracted=True):
            return a
        return self.new("neg", b) if self._is_nothing(a) else self.new("sub", a, b)

    def _mul(self, a: int, b: int) -> int:
        a, b = sorted((a, b), key=lambda v: (self.numbers.get(v) is None, v))
        x = self.numbers.get(a)
        if x == 0.0 and self.differentiating:
            return a
        return b if x == 1.0 else self.new("mul", a, b)

    def _div(self, a: int, b: int) -> int:
        return a if self.numbers.get(a) == 0.0 and self.differentiating else self.new("div", a, b)

    def _pow(self, a: int, b: int) -> int:
        y, one = self.numbers.get(b), self.constant(1.0)
        if y is None or not (abs(y) == 0.5 or (abs(y) <= HIGHEST_POWER and y == int(y))):
            return self.new("pow", a, b)
        if y == 0.0:
            return one
        power = self.apply("sqrt", a) if abs(y) == 0.5 else reduce(partial(self.apply, "mul"), [a] * int(abs(y)))
        return power if y > 0 else self.apply("div", one, power)


# Elementwise operators of torch

Scalar = Callable[..., int]
"""A function that applies an operator of torch to values of a program."""


def _sigmoid(p: Program, a: int) -> int:
    one = p.constant(1.0)
    return p.apply("div", one, p.apply("add", one, p.apply("exp", p.apply("neg", a))))


def _sign(p: Program, a: int) -> int:
    zero = p.constant(0.0)
    return p.apply("sub", p.apply("gt", a, zero), p.apply("lt", a, zero))


def _remainder(p: Program, a: int, b: int) -> int:
    """What is left of a division, with the sign of the divisor; exact, however large the quotient is."""
    remainder, zero = p.apply("fmod", a, b), p.constant(0.0)
    opposite = p.logic("xor", p.apply("lt", remainder, zero), p.apply("lt", b, zero))
    opposite = p.logic("and", opposite, p.apply("ne", remainder, zero))
    return p.select(opposite, p.apply("add", remainder, b), remainder)


def _to(name: str) -> Scalar:
    return lambda p, *operands: p.apply(name, *operands)


def _logic(name: str) -> Scalar:
    return lambda p, *operands: p.logic(name, *operands)


OF_ONE: dict[str, Scalar] = {
    **{name: _to(name) for name in (*ROUNDED, *FUNCTIONS, "neg") if FUNCTIONS.get(name, 1) == 1},
    **{f"{how}_not": _logic("not") for how in ("logical", "bitwise")},
    "reciprocal": lambda p, a: p.apply("div", p.constant(1.0), a),
    "rsqrt": lambda p, a: p.apply("div", p.constant(1.0), p.apply("sqrt", a)),
    "square": lambda p, a: p.apply("mul", a, a),
    "isnan": lambda p, a: p.apply("ne", a, a),
    "relu": lambda p, a: p.select(p.apply("lt", a, p.constant(0.0)), p.constant(0.0), a),
    "sign": _sign,
    "sgn": _sign,
    "sigmoid": _sigmoid,
}
OF_TWO: dict[str, Scalar] = {
    **{name: _to(name) for name in (*ARITHMETIC, *COMPARISONS, *EXTREMES)},
    **{name: _to(name) for name, count in FUNCTIONS.items() if count == 2},
    **{f"{how}_{name}": _logic(name) for how in ("logical", "bitwise") for name in ("and", "or", "xor")},
    "remainder": _remainder,
    "tanh_backward": lambda p, g, y: p.apply("mul", g, p.apply("sub", p.constant(1.0), p.apply("mul", y, y))),
    "sigmoid_backward": lambda p, g, y: p.apply("mul", g, p.apply("mul", y, p.apply("sub", p.constant(1.0), y))),
}
OF_THREE: dict[str, Scalar] = {
    "where": Program.select,
    "threshold_backward": lambda p, g, x, low: p.select(p.apply("le", x, low), p.constant(0.0), g),
}
ELEMENTWISE: dict[str, Scalar] = {**OF_ONE, **OF_TWO, **OF_THREE}
ARITY = {name: count for count, operators in enumerate((OF_ONE, OF_TWO, OF_THREE), 1) for name in operators}
