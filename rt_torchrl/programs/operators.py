"""Translations of torch's operators that are neither elementwise nor fills."""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce

import torch
from torch import Tensor

from rt_torchrl.programs.copies import COPIES
from rt_torchrl.programs.tracer import STRAIGHT, Arguments, Options, Rule, Tracer, in_shape

STRAIGHT_PRODUCT = 200
"""Greatest number of multiplications of a product of matrices that becomes straight-line code."""


def _convert(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    source, p = tracer.cells(args[0]), tracer.program
    if args[0].dtype == out.dtype:
        return source
    if out.dtype == torch.bool:
        convert: Callable[[int], int] = p.as_truth
    elif out.is_floating_point() and out.dtype != torch.float64:
        raise tracer.refuse(f"a conversion to {out.dtype}; trajectories need torch.float64")
    elif args[0].is_floating_point() and not out.is_floating_point():
        convert = partial(p.apply, "trunc")
    else:
        convert = p.as_number
    return in_shape([convert(i) for i in source.flatten().tolist()], source.shape)


# Elementwise operators with arguments of their own


def _clamp(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    low, high = (*args[1:], None, None)[:2]
    cells = tracer.cells(args[0]).expand(out.shape)
    for name, limit in (("maximum", options.get("min", low)), ("minimum", options.get("max", high))):
        if limit is not None:
            cells = tracer.pointwise(name, [cells, tracer.cells(limit)], out.shape)
    return cells


# Sums, products and folds


def _sum(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    cells, p = tracer.cells(args[0]), tracer.program
    rows = _rows(cells, args[1] if len(args) > 1 else options.get("dim"))
    m, n = rows.shape
    if m * n > 4 * STRAIGHT:
        ones = torch.full((n, 1), p.constant(1.0))
        return matrix_product(tracer, rows, ones).view(out.shape)
    found = [reduce(partial(p.apply, "add"), row) for row in rows.tolist()] if n else [p.constant(0.0)] * m
    return in_shape(found, out.shape)


def _fold(name: str) -> Rule:
    def rule(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
        rows = _rows(tracer.cells(args[0]), args[1] if len(args) > 1 else options.get("dim")).tolist()
        found = [reduce(partial(tracer.program.apply, name), row) for row in rows]
        return in_shape(found, out.shape)

    return rule


def _rows(cells: Tensor, dims: int | Sequence[int] | None) -> Tensor:
    """Cells as a matrix, with the dimensions ``dims`` (None or none for all) in its rows."""
    chosen = [dims] if isinstance(dims, int) else list(dims or range(cells.ndim))
    chosen = [d % cells.ndim for d in chosen]
    kept = [d for d in range(cells.ndim) if d not in chosen]
    return cells.permute(*kept, *chosen).reshape(math.prod(cells.shape[d] for d in kept), -1)


def matrix_product(tracer: Tracer, a: Tensor, b: Tensor, start: Tensor | None = None) -> Tensor:
    """The cells of ``start`` + a b: straight-line code, or one loop for large matrices."""
    p, (m, k), n = tracer.program, a.shape, b.shape[1]
    first = torch.full((m, n), p.constant(-0.0)) if start is None else start.expand(m, n)
    if m * k * n <= STRAIGHT_PRODUCT:
        found = []
        for row, starts in zip(a.tolist(), first.tolist(), strict=True):
            for column, total in zip(b.t().tolist(), starts, strict=True):
                for x, y in zip(row, column, strict=True):
                    total = p.apply("add", total, p.apply("mul", x, y))
                found.append(total)
        return in_shape(found, (m, n))
    if p.differentiating and 0.0 in (tracer.uniform_number(a), tracer.uniform_number(b)):
        return first
    return tracer.loop("product", (a, b, first), (m, n), k)


def _addmm(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    if options.get("beta", 1) != 1 or options.get("alpha", 1) != 1:
        raise tracer.refuse("addmm with alpha or beta")
    start, a, b = (tracer.cells(x) for x in args)
    return matrix_product(tracer, a, b, start)


# Tables


def _index(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    p, (source, indices) = tracer.program, args
    given = [i for i in indices if i is not None]
    cells = tracer.cells(source)
    if all(tracer.numbers(tracer.cells(i)) is not None for i in given):
        picked: Tensor = torch.ops.aten.index.Tensor(cells, indices)
        return picked
    if None in indices[: len(given)] or any(i.dtype == torch.bool for i in given):
        raise tracer.refuse("an index by a mask that varies, or after a full slice")
    numbers = tracer.numbers(cells)
    if numbers is None:
        raise tracer.refuse("a look-up at a varying place in a table that is learned or varies")
    table, rest = tracer.table(numbers), math.prod(source.shape[len(given) :])
    strides = torch.empty(source.shape, device="meta").stride()
    spread = torch.broadcast_tensors(*(tracer.cells(i) for i in given))
    zero, nan, found = p.constant(0.0), p.constant(math.nan), []
    for at in zip(*(s.flatten().tolist() for s in spread), strict=True):
        place, inside = zero, []
        for index, size, stride in zip(at, source.shape, strides, strict=False):
            first, end = p.constant(-float(size)), p.constant(float(size))
            inside.append(p.logic("and", p.apply("ge", index, first), p.apply("lt", index, end)))
            wrapped = p.select(p.apply("lt", index, zero), p.apply("add", index, end), index)
            safe = p.select(inside[-1], wrapped, zero)
            place = p.apply("add", place, p.apply("mul", safe, p.constant(float(stride))))
        numbers_there = (p.new("look_up", table, place, attributes=(r,)) for r in range(rest))
        found += [p.select(reduce(partial(p.logic, "and"), inside), x, nan) for x in numbers_there]
    return in_shape(found, out.shape)


RULES: dict[str, Rule] = {
    **COPIES,
    **dict.fromkeys(("clamp", "clamp_min"), _clamp),
    "zero": lambda tracer, args, options, out: tracer.cells(0.0),
    "_to_copy": _convert,
    "sum": _sum,
    "amax": _fold("maximum"),
    "amin": _fold("minimum"),
    "prod": _fold("mul"),
    "mm": lambda tracer, args, options, out: matrix_product(tracer, *map(tracer.cells, args)),
    "addmm": _addmm,
    "index": _index,
}


def new_tracer(straight: int = STRAIGHT) -> Tracer:
    """A tracer with all translations."""
    return Tracer(RULES, straight)
