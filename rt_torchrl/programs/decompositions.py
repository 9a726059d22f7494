"""Decompositions: operators of torch as torch code of simpler ones."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor


def _variance(x: Tensor, dim: Any = None, correction: int | float | None = None, *, keepdim: bool = False) -> Tensor:
    deviation = x - x.mean(dim, keepdim=True)
    total = (deviation * deviation).sum(dim, keepdim)
    return total / max(0.0, x.numel() / max(1, total.numel()) - (1.0 if correction is None else correction))


def _searchsorted(knots: Tensor, x: Any, *, right: bool = False, side: str = "", out_int32: bool = False) -> Tensor:
    return torch.bucketize(x, knots, right=right or side == "right", out_int32=out_int32)


SIMPLER: dict[str, Callable[..., Tensor]] = {
    "var": _variance,
    "searchsorted": _searchsorted,
    "clamp_max": lambda x, limit: torch.clamp(x, max=limit),
    "masked_fill": lambda x, mask, value: torch.where(mask, value, x),
    "deg2rad": lambda x: x * (math.pi / 180.0),
    "rsub": lambda a, b, alpha=1: -(alpha * a) + b,
    "bmm": lambda a, b: torch.stack([x @ y for x, y in zip(a, b, strict=True)]),
    "slice_backward": lambda x, sizes, *place: x.new_zeros(sizes).slice_scatter(x, *place),
    "select_backward": lambda x, sizes, *place: x.new_zeros(sizes).select_scatter(x, *place),
}
"""Operators that are common enough to do without the tables of torch."""


def known_to_torch(func: Any) -> Callable[..., Any] | None:
    """The way in which torch computes an operator by simpler ones; None if it knows none."""
    return _tables().get(func)


@cache
def _tables() -> dict[Any, Callable[..., Any]]:
    # These tables take a third of a second to import, and most code needs none of them.
    from torch._decomp import core_aten_decompositions, decomposition_table

    return {**decomposition_table, **core_aten_decompositions()}
