"""Elementwise operators of torch as scalar operations of a program."""

from collections.abc import Callable

from rt_torchrl.programs.operations import ARITHMETIC, COMPARISONS, EXTREMES, FUNCTIONS, ROUNDED
from rt_torchrl.programs.program import Program

Scalar = Callable[..., int]


def _sigmoid(p: Program, a: int) -> int:
    one = p.constant(1.0)
    return p.apply("div", one, p.apply("add", one, p.apply("exp", p.apply("neg", a))))


def _sign(p: Program, a: int) -> int:
    zero = p.constant(0.0)
    return p.apply("sub", p.apply("gt", a, zero), p.apply("lt", a, zero))


def _remainder(p: Program, a: int, b: int) -> int:
    """What is left of a division, with the sign of the divisor; exact, however large the quotient is."""
    left, zero = p.apply("fmod", a, b), p.constant(0.0)
    opposite = p.logic("xor", p.apply("lt", left, zero), p.apply("lt", b, zero))
    return p.select(p.logic("and", opposite, p.apply("ne", left, zero)), p.apply("add", left, b), left)


def _number_of(how: str) -> Scalar:
    """Minimum or maximum that prefers a number to NaN."""
    return lambda p, a, b: p.select(p.logic("or", p.apply(how, a, b), p.apply("ne", b, b)), a, b)


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
    "fmin": _number_of("lt"),
    "fmax": _number_of("gt"),
    "remainder": _remainder,
    "tanh_backward": lambda p, g, y: p.apply("mul", g, p.apply("sub", p.constant(1.0), p.apply("mul", y, y))),
    "sigmoid_backward": lambda p, g, y: p.apply("mul", g, p.apply("mul", y, p.apply("sub", p.constant(1.0), y))),
}
ELEMENTWISE: dict[str, Scalar] = {**OF_ONE, **OF_TWO, "where": Program.select}
ARITY = {**dict.fromkeys(OF_ONE, 1), **dict.fromkeys(OF_TWO, 2), "where": 3}
IN_LOOPS = frozenset((*ROUNDED, *(name for name, count in FUNCTIONS.items() if count == 1), *ARITHMETIC)) | set(
    "neg pow atan2 square reciprocal tanh_backward sigmoid sigmoid_backward".split()
)
"""Operators that the loop of a long row may hold; the others become straight-line code."""
