"""Elementwise operators of torch as scalar operations of a program."""

from collections.abc import Callable

from rt_torchrl.programs.program import COMPARISONS, UNARY, Program

Scalar = Callable[..., int]
LOGIC = ("and", "or", "xor", "not")


def _sigmoid(p: Program, a: int) -> int:
    one = p.constant(1.0)
    return p.div(one, p.add(one, p.unary("exp", p.neg(a))))


def _sign(p: Program, a: int) -> int:
    zero = p.constant(0.0)
    return p.sub(p.as_number(p.compare("ogt", a, zero)), p.as_number(p.compare("olt", a, zero)))


def _one_minus_square(p: Program, a: int) -> int:
    return p.sub(p.constant(1.0), p.mul(a, a))


def _remainder(p: Program, a: int, b: int) -> int:
    """What is left of a division, with the sign of the divisor; exact, however large the quotient is."""
    a, b, zero = p.as_number(a), p.as_number(b), p.constant(0.0)
    left = p.binary("fmod", a, b)
    opposite = p.logic("xor", p.compare("olt", left, zero), p.compare("olt", b, zero))
    return p.select(p.logic("and", opposite, p.compare("une", left, zero)), p.add(left, b), left)


def _number_of(how: str) -> Scalar:
    """Minimum or maximum that prefers a number to NaN."""
    return lambda p, a, b: p.select(p.logic("or", p.compare(how, a, b), p.compare("une", b, b)), a, b)


def _named(operation: Scalar, name: str) -> Scalar:
    """One of the operations of a program that have a common method."""
    return lambda p, *operands: operation(p, name, *operands)


ELEMENTWISE: dict[str, Scalar] = {
    **{name: _named(Program.unary, name) for name in UNARY},
    **{name: _named(Program.compare, how) for name, how in COMPARISONS.items()},
    **{f"logical_{how}": _named(Program.logic, how) for how in LOGIC},
    **{f"bitwise_{how}": _named(Program.logic, how) for how in LOGIC},
    "add": Program.add,
    "sub": Program.sub,
    "mul": Program.mul,
    "div": Program.div,
    "pow": Program.pow,
    "where": Program.select,
    **{name: _named(Program.extreme, name) for name in ("minimum", "maximum")},
    **{name: _named(Program.binary, name) for name in ("atan2", "hypot", "fmod")},
    "fmin": _number_of("olt"),
    "fmax": _number_of("ogt"),
    "reciprocal": lambda p, a: p.div(p.constant(1.0), a),
    "rsqrt": lambda p, a: p.div(p.constant(1.0), p.unary("sqrt", a)),
    "square": lambda p, a: p.mul(a, a),
    "isnan": lambda p, a: p.compare("une", a, a),
    "relu": lambda p, a: p.select(p.compare("olt", a, p.constant(0.0)), p.constant(0.0), a),
    "sign": _sign,
    "sgn": _sign,
    "sigmoid": _sigmoid,
    "remainder": _remainder,
    "tanh_backward": lambda p, g, y: p.mul(g, _one_minus_square(p, y)),
    "sigmoid_backward": lambda p, g, y: p.mul(g, p.mul(y, p.sub(p.constant(1.0), y))),
}
ARITY = {
    **dict.fromkeys(ELEMENTWISE, 2),
    **dict.fromkeys((*UNARY, "reciprocal", "rsqrt", "square", "isnan", "relu", "sign", "sgn", "sigmoid"), 1),
    **dict.fromkeys(("logical_not", "bitwise_not"), 1),
    "where": 3,
}
IN_LOOPS = UNARY | set("add sub mul div pow atan2 square reciprocal tanh_backward sigmoid sigmoid_backward".split())
"""Operators that the loop of a long row may hold; the others become straight-line code."""
