"""Translations of torch's operators: rules for what is neither elementwise nor a fill, and decompositions."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial, reduce
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from rt_torchrl.programs.tracer import STRAIGHT, Arguments, Options, Rule, Tracer, in_shape

STRAIGHT_PRODUCT = 200
"""Greatest number of multiplications of a product of matrices that becomes straight-line code."""
LARGEST_SOLVED = 6
"""Greatest size of a matrix that is eliminated."""
SPREAD = 4096
"""Greatest number of places times assigned numbers of an assignment to places that vary."""


def _convert(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    source, p = tracer.cells(args[0]), tracer.program
    if args[0].dtype == out.dtype:
        return source
    if out.dtype == torch.bool:
        convert: Callable[[int], int] = p.as_truth
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


def _fold(name: str, empty: float = 0.0) -> Rule:
    def rule(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
        p, rows = tracer.program, _rows(tracer.cells(args[0]), args[1] if len(args) > 1 else options.get("dim"))
        if name == "add" and rows.numel() > 4 * STRAIGHT:
            ones = torch.full((rows.shape[1], 1), p.constant(1.0))
            return matrix_product(tracer, rows, ones).view(out.shape)
        folds = [reduce(partial(p.apply, name), row) if row else p.constant(empty) for row in rows.tolist()]
        return in_shape(folds, out.shape)

    return rule


def _rows(cells: Tensor, dims: int | Sequence[int] | None) -> Tensor:
    """Cells as a matrix, with the dimensions ``dims`` (None or none for all) in its rows."""
    chosen = [dims] if isinstance(dims, int) else list(dims or range(cells.ndim))
    chosen = [d % cells.ndim for d in chosen]
    remaining = [d for d in range(cells.ndim) if d not in chosen]
    return cells.permute(*remaining, *chosen).reshape(math.prod(cells.shape[d] for d in remaining), -1)


def matrix_product(tracer: Tracer, a: Tensor, b: Tensor, start: Tensor | None = None) -> Tensor:
    """The cells of ``start`` + a b: straight-line code, or one loop for large matrices."""
    p, (m, k), n = tracer.program, a.shape, b.shape[1]
    first = torch.full((m, n), p.constant(-0.0)) if start is None else start.expand(m, n)
    if m * k * n <= STRAIGHT_PRODUCT:
        totals = []
        for row, starts in zip(a.tolist(), first.tolist(), strict=True):
            for column, total in zip(b.t().tolist(), starts, strict=True):
                for x, y in zip(row, column, strict=True):
                    total = p.apply("add", total, p.apply("mul", x, y))
                totals.append(total)
        return in_shape(totals, (m, n))
    if p.differentiating and 0.0 in (tracer.uniform_number(a), tracer.uniform_number(b)):
        return first
    return tracer.loop("product", (a, b, first), (m, n), k)


def _addmm(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    if options.get("beta", 1) != 1 or options.get("alpha", 1) != 1:
        raise tracer.refuse("addmm with alpha or beta", "multiply by them")
    start, a, b = (tracer.cells(x) for x in args)
    return matrix_product(tracer, a, b, start)


# Tables


def _index(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    p, (source, indices) = tracer.program, args
    tensors = [i for i in indices if i is not None]
    cells = tracer.cells(source)
    if all(tracer.numbers(tracer.cells(i)) is not None for i in tensors):
        picked: Tensor = torch.ops.aten.index.Tensor(cells, indices)
        return picked
    array, walk = tracer.access(cells.flatten())
    nan, rest, values = p.constant(math.nan), math.prod(source.shape[len(tensors) :]), []
    for place, inside in _places(tracer, source.shape, indices):
        if walk is None:
            elements = [array] * rest
        else:
            (stride,) = walk.strides
            place = p.apply("mul", place, p.constant(float(stride)))
            offsets = [walk.base + stride * r for r in range(rest)]
            elements = [p.new("look_up", array, place, attributes=(offset,)) for offset in offsets]
        values += [p.select(inside, x, nan) for x in elements]
    return in_shape(values, out.shape)


def _places(tracer: Tracer, shape: Sequence[int], indices: Sequence[Tensor | None]) -> Iterator[tuple[int, int]]:
    """Of every entry of indices that vary: its place in a tensor side by side, and whether it lies in the tensor."""
    p, tensors = tracer.program, [i for i in indices if i is not None]
    if None in indices[: len(tensors)] or any(i.dtype == torch.bool for i in tensors):
        raise tracer.refuse("an index by a mask that varies, or after a full slice", "use torch.where")
    strides, zero = torch.empty(tuple(shape), device="meta").stride(), p.constant(0.0)
    spread = torch.broadcast_tensors(*(tracer.cells(i) for i in tensors))
    for at in zip(*(s.flatten().tolist() for s in spread), strict=True):
        place, inside = zero, []
        for index, size, stride in zip(at, shape, strides, strict=False):
            first, end = p.constant(-float(size)), p.constant(float(size))
            inside.append(p.logic("and", p.apply("ge", index, first), p.apply("lt", index, end)))
            wrapped = p.select(p.apply("lt", index, zero), p.apply("add", index, end), index)
            safe = p.select(inside[-1], wrapped, zero)
            place = p.apply("add", place, p.apply("mul", safe, p.constant(float(stride))))
        yield place, reduce(partial(p.logic, "and"), inside)


def _index_put(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    target, indices, values = args[:3]
    p, cells = tracer.program, tracer.cells(target).flatten().tolist()
    added = (*args[3:], options.get("accumulate", False))[0]
    tensors = [i for i in indices if i is not None]
    if all(tracer.numbers(tracer.cells(i)) is not None for i in tensors):
        places = torch.ops.aten.index.Tensor(torch.arange(target.numel()).view(target.shape), indices)
        assigned = tracer.cells(values).expand(places.shape).flatten().tolist()
        for place, value in zip(places.flatten().tolist(), assigned, strict=True):
            cells[place] = p.apply("add", cells[place], value) if added else value
        return in_shape(cells, target.shape)
    rest = target.shape[len(tensors) :]
    at = torch.broadcast_shapes(*(i.shape for i in tensors))
    rows = tracer.cells(values).expand(*at, *rest).reshape(-1, math.prod(rest)).tolist()
    if len(rows) * len(cells) > SPREAD:
        raise tracer.refuse(f"an assignment to {len(cells)} places that vary", "use torch.where")
    for (place, inside), row in zip(_places(tracer, target.shape, indices), rows, strict=True):
        for j, before in enumerate(cells):
            first, r = divmod(j, len(row))
            hit = p.logic("and", inside, p.apply("eq", place, p.constant(float(first * len(row)))))
            new = p.apply("add", before, row[r]) if added else row[r]
            cells[j] = p.select(hit, new, before)
    return in_shape(cells, target.shape)


# Copies, carried out on the cells


def _copy_by(name: str) -> Rule:
    """An operator on the cells."""
    operator = getattr(torch.ops.aten, name)

    def rule(tracer: Tracer, args: Arguments, options: Options, out: Any) -> Any:
        def celled(x: Any) -> Any:
            if isinstance(x, Tensor):
                return tracer.cells(x)
            return [celled(y) for y in x] if isinstance(x, (list, tuple)) else x

        keywords = {key: value for key, value in options.items() if key != "memory_format"}
        return operator(*map(celled, args), **keywords)

    return rule


PLAIN = (
    "cat stack flip roll repeat expand_copy slice_scatter select_scatter diagonal_scatter unfold_copy view_copy "
    "permute_copy _unsafe_view alias_copy clone contiguous lift_fresh lift_fresh_copy"
).split()
RULES: dict[str, Rule] = {
    **dict.fromkeys(("clamp", "clamp_min"), _clamp),
    "zero": lambda tracer, args, options, out: tracer.cells(0.0),
    "_to_copy": _convert,
    "sum": _fold("add"),
    "amax": _fold("maximum"),
    "amin": _fold("minimum"),
    "prod": _fold("mul", 1.0),
    "mm": lambda tracer, args, options, out: matrix_product(tracer, *map(tracer.cells, args)),
    "addmm": _addmm,
    "index": _index,
    "_linalg_check_errors": lambda tracer, args, options, out: [],
    **{name: _copy_by(name) for name in PLAIN},
    **dict.fromkeys(("copy", "fill"), lambda tracer, args, options, out: tracer.cells(args[1])),
    **dict.fromkeys(("index_put", "_unsafe_index_put"), _index_put),
}

# Operators as torch code of simpler ones


def _variance(x: Tensor, dim: Any = None, correction: int | float | None = None, *, keepdim: bool = False) -> Tensor:
    deviation = x - x.mean(dim, keepdim=True)
    total = (deviation * deviation).sum(dim, keepdim)
    return total / max(0.0, x.numel() / max(1, total.numel()) - (1.0 if correction is None else correction))


def _along(dim: int, index: Tensor) -> tuple[Tensor, ...]:
    """The places of an index along a dimension."""
    places = [*torch.meshgrid(*map(torch.arange, index.shape), indexing="ij")]
    places[dim] = index
    return tuple(places)


def _gather(x: Tensor, dim: int, index: Tensor, *, sparse_grad: bool = False) -> Tensor:
    return x[_along(dim, index)]


def _scatter(x: Tensor, dim: int, index: Tensor, source: Any, *, added: bool = False) -> Tensor:
    if isinstance(source, Tensor):
        source = source[tuple(map(slice, index.shape))]
    return x.index_put(_along(dim, index), torch.as_tensor(source, dtype=x.dtype), accumulate=added)


def _bucketize(x: Any, knots: Tensor, *, out_int32: bool = False, right: bool = False) -> Tensor:
    above = (torch.gt if right else torch.ge)(knots, torch.as_tensor(x).unsqueeze(-1))
    return (~above).sum(-1)  # NaN is above nothing


def _cumulative(step: Callable[[Tensor, Tensor], Tensor]) -> Callable[..., Tensor]:
    return lambda x, dim: torch.stack([*accumulate(x.unbind(dim), step)], dim)


def _extreme(of_all: Callable[..., Tensor], of_two: Callable[..., Tensor]) -> Callable[..., Any]:
    """Greatest or least number of all, of two tensors, or of each row with its first place; NaN is both."""

    def extreme(x: Tensor, other: Any = None, keepdim: bool = False) -> Any:
        if other is None or isinstance(other, Tensor):
            return of_all(x) if other is None else of_two(x, other)
        value = of_all(x, other, keepdim=True)
        place = (~((x == value) | x.isnan())).double().cumprod(other).sum(other, keepdim=True).long()
        return (value, place) if keepdim else (value.squeeze(other), place.squeeze(other))

    return extreme


def _solved(A: Tensor, B: Tensor, *, left: bool = True) -> Tensor:
    """X of A X = B, or of X A = B, by elimination with partial pivoting."""
    if not left:
        return _solved(A.mT, B.mT).mT
    n, lead = A.shape[-1], torch.broadcast_shapes(A.shape[:-2], B.shape[:-2])
    if n > LARGEST_SOLVED:
        raise ValueError(f"linear equations of {n} unknowns, more than {LARGEST_SOLVED}")
    rows = [*torch.cat([x.expand(*lead, *x.shape[-2:]) for x in (A, B)], -1).unbind(-2)]
    for k in range(n):
        for i in range(k + 1, n):  # of the two rows, the one with the greater pivot goes first
            greater = rows[i][..., k : k + 1].abs() > rows[k][..., k : k + 1].abs()
            rows[k], rows[i] = torch.where(greater, rows[i], rows[k]), torch.where(greater, rows[k], rows[i])
        for i in range(k + 1, n):
            rows[i] = rows[i] - rows[i][..., k : k + 1] / rows[k][..., k : k + 1] * rows[k]
    solution: list[Tensor] = []
    for k in reversed(range(n)):
        total = rows[k][..., n:]
        for j, x in enumerate(solution, k + 1):
            total = total - rows[k][..., j : j + 1] * x
        solution.insert(0, total / rows[k][..., k : k + 1])
    return torch.stack(solution, -2)


def _solve(A: Tensor, B: Tensor, *, left: bool = True, check_errors: bool = False) -> tuple[Tensor, ...]:
    """X, and in the place of the factors of A this matrix itself, which the gradient takes."""
    vector = B.ndim == 1 or (B.ndim == A.ndim - 1 and B.shape == A.shape[:-1])
    X = _solved(A, B.unsqueeze(-1) if vector else B, left=left)
    nothing = torch.zeros(A.shape[:-1], dtype=torch.int32)
    return X.squeeze(-1) if vector else X, A, nothing, nothing[..., 0]


def _invert(A: Tensor, *, check_errors: bool = False) -> tuple[Tensor, ...]:
    return _solved(A, torch.eye(A.shape[-1], dtype=A.dtype)), torch.zeros(A.shape[:-2], dtype=torch.int32)


DECOMPOSITIONS: dict[str, Callable[..., Any]] = {
    "_linalg_solve_ex": _solve,
    "linalg_lu_solve": lambda A, _, B, *, left=True, adjoint=False: _solved(A.mT if adjoint else A, B, left=left),
    "linalg_inv_ex": _invert,
    "var": _variance,
    "gather": _gather,
    "scatter": _scatter,
    "scatter_add": partial(_scatter, added=True),
    "bucketize": _bucketize,
    "searchsorted": lambda knots, x, side="", **how: _bucketize(x, knots, **{"right": side == "right", **how}),
    "cumsum": _cumulative(torch.add),
    "cumprod": _cumulative(torch.mul),
    "max": _extreme(torch.amax, torch.maximum),
    "min": _extreme(torch.amin, torch.minimum),
    "bmm": lambda a, b: torch.stack([x @ y for x, y in zip(a, b, strict=True)]),
}
"""Operators in another way than torch's own."""


@cache
def decompositions_of_torch() -> dict[Any, Callable[..., Any]]:
    """The ways in which torch computes operators by simpler ones."""
    # These tables take some tenths of a second, and some code needs none of them.
    from torch._decomp import core_aten_decompositions, decomposition_table

    return {**decomposition_table, **core_aten_decompositions()}


def new_tracer(straight: int = STRAIGHT) -> Tracer:
    """A tracer with all translations."""
    return Tracer(RULES, DECOMPOSITIONS, decompositions_of_torch, straight)
