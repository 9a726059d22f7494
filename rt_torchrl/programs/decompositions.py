"""Decompositions: operators of torch as torch code of simpler ones."""

import math
from collections.abc import Callable
from functools import cache
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor


def _mean(x: Tensor, dim: Any = None, keepdim: bool = False) -> Tensor:
    total = x.sum(dim, keepdim)
    return total / (x.numel() // max(1, total.numel()))


def _variance(x: Tensor, dim: Any = None, correction: int | float | None = None, *, keepdim: bool = False) -> Tensor:
    deviation = x - _mean(x, dim, keepdim=True)
    total = (deviation * deviation).sum(dim, keepdim)
    return total / max(0.0, x.numel() / max(1, total.numel()) - (1.0 if correction is None else correction))


def _scatter_add(x: Tensor, dim: int, index: Tensor, source: Tensor) -> Tensor:
    places: list[Tensor | None] = [*torch.meshgrid(*map(torch.arange, index.shape), indexing="ij")]
    places[dim] = index
    return x.index_put(places, source[tuple(map(slice, index.shape))], accumulate=True)


def _bucketize(x: Any, knots: Tensor, *, out_int32: bool = False, right: bool = False) -> Tensor:
    above = (torch.gt if right else torch.ge)(knots, torch.as_tensor(x).unsqueeze(-1))
    return (~above).sum(-1)  # NaN is above nothing


def _cumulative(step: Callable[[Tensor, Tensor], Tensor]) -> Callable[..., Tensor]:
    return lambda x, dim: torch.stack([*accumulate(x.unbind(dim), step)], dim)


def _extreme(of_all: Callable[..., Tensor], of_two: Callable[..., Tensor]) -> Callable[..., Any]:
    """Greatest or least number of all, of two tensors, or of each row with its first place; NaN is both."""

    def found(x: Tensor, other: Any = None, keepdim: bool = False) -> Any:
        if other is None or isinstance(other, Tensor):
            return of_all(x) if other is None else of_two(x, other)
        value = of_all(x, other, keepdim=True)
        place = (~((x == value) | x.isnan())).double().cumprod(other).sum(other, keepdim=True).long()
        return (value, place) if keepdim else (value.squeeze(other), place.squeeze(other))

    return found


SIMPLER: dict[str, Callable[..., Any]] = {
    "mean": _mean,
    "var": _variance,
    "scatter_add": _scatter_add,
    "bucketize": _bucketize,
    "searchsorted": lambda knots, x, side="", **how: _bucketize(x, knots, **{"right": side == "right", **how}),
    "cumsum": _cumulative(torch.add),
    "cumprod": _cumulative(torch.mul),
    "max": _extreme(torch.amax, torch.maximum),
    "min": _extreme(torch.amin, torch.minimum),
    "clamp_max": lambda x, limit: torch.clamp(x, max=limit),
    "masked_fill": lambda x, mask, value: torch.where(mask, value, x),
    "deg2rad": lambda x: x * (math.pi / 180.0),
    "rsub": lambda a, b, alpha=1: -(alpha * a) + b,
    "bmm": lambda a, b: torch.stack([x @ y for x, y in zip(a, b, strict=True)]),
    "slice_backward": lambda x, sizes, *place: x.new_zeros(sizes).slice_scatter(x, *place),
    "select_backward": lambda x, sizes, *place: x.new_zeros(sizes).select_scatter(x, *place),
}
"""Operators that are common enough to do without the tables of torch."""


@cache
def tables_of_torch() -> dict[Any, Callable[..., Any]]:
    """The ways in which torch computes operators by simpler ones."""
    # These tables take a third of a second to import, and most code needs none of them.
    from torch._decomp import core_aten_decompositions, decomposition_table

    return {**decomposition_table, **core_aten_decompositions()}
