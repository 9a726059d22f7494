"""Translations of torch's operators that copy: carried out on the cells of a tracer."""

from itertools import product
from typing import Any

import torch
from torch import Tensor

from rt_torchrl.programs.tracer import Arguments, Options, Rule, Tracer, in_shape


def _copy_by(name: str) -> Rule:
    """An operator on the cells; an index, which is its third argument, must be known."""
    operator = getattr(torch.ops.aten, name)

    def rule(tracer: Tracer, args: Arguments, options: Options, out: Any) -> Any:
        def celled(x: Any) -> Any:
            if isinstance(x, Tensor):
                return tracer.cells(x)
            return [celled(y) for y in x] if isinstance(x, (list, tuple)) else x

        index = args[2:] if name in INDEXED else ()
        tracer.require_known(f"{name} by an index that varies", index)
        kept = {key: value for key, value in options.items() if key != "memory_format"}
        return operator(*map(celled, args[: len(args) - len(index)]), *index, **kept)

    return rule


def _overwrite(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    return tracer.cells(args[1])


def _scatter(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    if "reduce" in options:
        raise tracer.refuse("scatter with an operation")
    cells, (dim, index), p = tracer.cells(args[0]), args[1:3], tracer.program
    source = tracer.cells(args[3]).expand(index.shape)
    if tracer.numbers(tracer.cells(index)) is not None:
        return cells.scatter(dim, index, source)
    found = cells.movedim(dim, -1).clone()
    chosen, values = (x.movedim(dim, -1) for x in (tracer.cells(index), source))
    for at in product(*map(range, chosen.shape)):
        for j in range(found.shape[-1]):
            hit = p.apply("eq", int(chosen[at]), p.constant(float(j)))
            there = (*at[:-1], j)
            found[there] = p.select(hit, int(values[at]), int(found[there]))
    return found.movedim(-1, dim)


def _index_put(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    tracer.require_known("an assignment to places that vary", args[1])
    target, indices, values = args[:3]
    places = torch.ops.aten.index.Tensor(torch.arange(target.numel()).view(target.shape), indices)
    source, found = tracer.cells(values).expand(places.shape), tracer.cells(target).flatten().tolist()
    added = (*args[3:], options.get("accumulate", False))[0]
    for place, value in zip(places.flatten().tolist(), source.flatten().tolist(), strict=True):
        found[place] = tracer.program.apply("add", found[place], value) if added else value
    return in_shape(found, target.shape)


def _pad(tracer: Tracer, args: Arguments, options: Options, out: Tensor) -> Tensor:
    filling = tracer.program.constant(float(args[2]) if len(args) > 2 else 0.0)
    return torch.constant_pad_nd(tracer.cells(args[0]), args[1], filling)


INDEXED = ("gather", "index_select")
PLAIN = (
    "cat stack flip roll repeat expand_copy diag_embed slice_scatter select_scatter unfold_copy view_copy permute_copy "
    "_unsafe_view alias_copy clone contiguous lift_fresh lift_fresh_copy"
).split()
COPIES: dict[str, Rule] = {
    **{name: _copy_by(name) for name in (*PLAIN, *INDEXED)},
    **dict.fromkeys(("copy", "fill"), _overwrite),
    "scatter": _scatter,
    **dict.fromkeys(("index_put", "_unsafe_index_put"), _index_put),
    "constant_pad_nd": _pad,
}
