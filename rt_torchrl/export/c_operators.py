"""C99 expressions of the operators of a traced policy; all operands are double.

Comparisons keep a NaN among the operands, as torch does and C's fmin and fmax do not.
A truth value is 0.0 or 1.0.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

aten = torch.ops.aten


def literal(value: float | int) -> str:
    """A number in C, which is read back to the bit."""
    value = float(value)
    if math.isnan(value):
        return "NAN"
    text = "INFINITY" if math.isinf(value) else repr(abs(value))
    return f"(-{text})" if math.copysign(1.0, value) < 0 else text


def call(function: str) -> Callable[..., str]:
    """A call of a function of math.h."""
    return lambda *operands: f"{function}({', '.join(operands)})"


def infix(operator: str) -> Callable[..., str]:
    return lambda x, y: f"{x} {operator} {y}"


def compared(operator: str) -> Callable[..., str]:
    return lambda x, y: f"{x} {operator} {y} ? 1.0 : 0.0"


def both(x: str, y: str) -> str:
    return f"{x} != 0.0 && {y} != 0.0 ? 1.0 : 0.0"


def either(x: str, y: str) -> str:
    return f"{x} != 0.0 || {y} != 0.0 ? 1.0 : 0.0"


def scaled_infix(operator: str) -> Callable[..., str]:
    return lambda x, y, alpha="1.0": f"{x} {operator} {y}" if alpha == "1.0" else f"{x} {operator} {alpha} * {y}"


def power(x: str, y: str) -> str:
    return {"2.0": f"{x} * {x}", "3.0": f"{x} * {x} * {x}"}.get(y, f"pow({x}, {y})")


def extremum(operator: str) -> Callable[..., str]:
    return lambda x, y: f"({x} {operator} {y} || isnan({x})) ? {x} : {y}"


def clamp(x: str, low: str | None = None, high: str | None = None) -> str:
    """An operand, clamped to its bounds; the upper bound wins where they cross, as in torch."""
    inner = x if high is None else f"({x} > {high} ? {high} : {x})"
    if low is None:
        return inner
    raised = f"({x} < {low} ? {low} : {x})"
    return raised if high is None else f"({raised} > {high} ? {high} : {raised})"


def elu(x: str, alpha: str = "1.0", scale: str = "1.0", input_scale: str = "1.0") -> str:
    return f"{x} > 0.0 ? {scale} * {x} : {scale} * {alpha} * expm1({input_scale} * {x})"


def gelu(x: str, approximate: str = "none") -> str:
    if approximate == "tanh":
        return f"0.5 * {x} * (1.0 + tanh({literal(math.sqrt(2 / math.pi))} * ({x} + 0.044715 * {x} * {x} * {x})))"
    return f"0.5 * {x} * (1.0 + erf({x} * {literal(math.sqrt(0.5))}))"


FUNCTIONS = (
    *("acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "ceil", "cos", "cosh", "erf", "exp", "exp2", "expm1"),
    *("floor", "fmod", "hypot", "log", "log10", "log1p", "log2", "sin", "sinh", "sqrt", "tan", "tanh", "trunc"),
)
"""Functions of math.h that torch has under the same name."""

ELEMENTWISE: dict[str, Callable[..., str]] = {name: call(name) for name in FUNCTIONS} | {
    "abs": call("fabs"),
    "add": scaled_infix("+"),
    "bitwise_and": both,
    "bitwise_not": lambda x: f"{x} == 0.0 ? 1.0 : 0.0",
    "bitwise_or": either,
    "clamp": clamp,
    "clamp_max": lambda x, high: clamp(x, None, high),
    "clamp_min": clamp,
    "div": infix("/"),
    "elu": elu,
    "eq": compared("=="),
    "ge": compared(">="),
    "gelu": gelu,
    "gt": compared(">"),
    "hardtanh": lambda x, low="(-1.0)", high="1.0": clamp(x, low, high),
    "le": compared("<="),
    "leaky_relu": lambda x, slope="0.01": f"{x} > 0.0 ? {x} : {slope} * {x}",
    "logical_and": both,
    "logical_not": lambda x: f"{x} == 0.0 ? 1.0 : 0.0",
    "logical_or": either,
    "lt": compared("<"),
    "maximum": extremum(">"),
    "minimum": extremum("<"),
    "mul": infix("*"),
    "ne": compared("!="),
    "neg": lambda x: f"-{x}",
    "pow": power,
    "reciprocal": lambda x: f"1.0 / {x}",
    "relu": lambda x: f"{x} < 0.0 ? 0.0 : {x}",
    "rsqrt": lambda x: f"1.0 / sqrt({x})",
    "sigmoid": lambda x: f"1.0 / (1.0 + exp(-{x}))",
    "sign": lambda x: f"{x} > 0.0 ? 1.0 : ({x} < 0.0 ? (-1.0) : {x})",
    "sub": scaled_infix("-"),
    "where": lambda condition, x, y: f"{condition} != 0.0 ? {x} : {y}",
}
"""C expression of an operator's result, by its name in torch; operands are elements of arrays or literals."""

READ_ONCE = frozenset([*FUNCTIONS, "abs", "add", "div", "mul", "neg", "reciprocal", "rsqrt", "sigmoid", "sub"])
"""Operators whose expression holds each operand once, so that an operand may itself be an expression."""

MOVING = frozenset(
    ["alias", "clone", "detach", "diagonal", "expand", "flip", "gather", "getitem", "index", "index_select", "permute"]
    + [
        "repeat",
        "roll",
        "select",
        "slice",
        "split",
        "split_with_sizes",
        "squeeze",
        "t",
        "transpose",
        "unbind",
        "unfold",
    ]
    + ["unsqueeze", "view"]
)
"""Operators that only choose and arrange elements of one array."""

FILLING = frozenset(["full_like", "new_full", "new_zeros", "new_ones", "ones_like", "zeros_like"])
"""Operators that take the shape of a tensor, not its values."""

CHECKS = frozenset(["_assert_tensor_metadata"])
"""Operators that compute nothing but check what held when the policy was traced."""


def layer_norm(
    x: Tensor, shape: Sequence[int], weight: Tensor | None, bias: Tensor | None, eps: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Layer normalisation in simpler operators."""
    over = list(range(x.dim() - len(shape), x.dim()))
    mean = x.mean(over, keepdim=True)
    rate = ((x - mean) ** 2).mean(over, keepdim=True).add(eps).rsqrt()
    return _affine((x - mean) * rate, weight, bias), mean, rate


def batch_norm(
    x: Tensor,
    weight: Tensor | None,
    bias: Tensor | None,
    mean: Tensor,
    variance: Tensor,
    momentum: float,
    eps: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Batch normalisation with the statistics of the training, over dimension 1."""
    shape = [-1] + [1] * (x.dim() - 2)
    weight, bias = (v if v is None else v.view(shape) for v in (weight, bias))
    rate = (variance.view(shape) + eps).rsqrt()
    empty = x.new_zeros(0)
    return _affine((x - mean.view(shape)) * rate, weight, bias), empty, empty


def _affine(x: Tensor, weight: Tensor | None, bias: Tensor | None) -> Tensor:
    x = x if weight is None else x * weight
    return x if bias is None else x + bias


DECOMPOSED = {
    aten.native_layer_norm.default: layer_norm,
    aten._native_batch_norm_legit_no_training.default: batch_norm,
}
"""Layers that torch keeps whole, as functions of simpler operators."""
