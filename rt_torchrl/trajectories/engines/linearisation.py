"""The Jacobians of all intervals of all trajectories as one batched call."""

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn

from rt_torchrl.trajectories.engines.compilation import marked_dynamic, plain
from rt_torchrl.trajectories.engines.interval import Drive, with_weights

PIECE = 2048
"""Number of intervals that are linearised at once, which bounds the memory. Forward mode ties a compiled graph to one
number of intervals; with this fixed number one graph serves all trajectories that are not shorter."""


def prepared(initial_state: Tensor, drive: Drive) -> tuple[Tensor, Drive]:
    """State and drive in memory of their own, marked so that one compiled graph serves all batch sizes."""
    copies = Drive(drive.t, plain(drive.exogenous), plain(drive.command))
    for tensor in copies if drive.t.shape[1] > 1 else copies[1:]:
        marked_dynamic(tensor, 1)
    return marked_dynamic(plain(initial_state), 0), copies


def as_one_batch(starts: Tensor, drive: Drive) -> tuple[Tensor, Drive]:
    """The intervals of all realisations as ``n·batch`` rows.

    A function of single intervals does not depend on the trajectories that these belong to. As rows, one graph serves
    every length and every number of realisations, and its loops run over one dimension. With loops over both time and
    realisations, of which t has only the time, the compiler takes a minute for the step of a drone.
    """
    t = drive.t.expand(starts.shape[:2]).flatten()
    return starts.flatten(0, 1), Drive(t, drive.exogenous.flatten(0, 1), drive.command.flatten(0, 1))


def piece(rows: Tensor, drive: Drive, first: int, last: int) -> tuple[Tensor, Drive]:
    """Rows ``first`` to ``last`` − 1 in memory of their own.

    The compiler traces a view together with the tensor behind it. Behind the rows is a tensor ``n batch ...`` with two
    unknown sizes, of which the compiler finds only the product; it then gives up.
    """
    return plain(rows[first:last]), Drive(*(plain(x[first:last]) for x in drive))


def pieces(count: int) -> list[slice]:
    """Cut ``count`` rows into as few pieces as :data:`PIECE` allows, with lengths that differ by one at most.

    No piece is left with a single row, for which the compiler would trace again.
    """
    number = -(-count // PIECE)
    ends = [count * k // number for k in range(number + 1)]
    return [slice(*pair) for pair in pairwise(ends)]


def over_all(
    function: Callable[[Tensor, Drive], Tensor], starts: Tensor, drive: Drive, *, at_once: int | None = None
) -> Tensor:
    """``function`` of every interval, ``n batch ...``, in pieces of which the last one may overlap another.

    Args:
        function: a function of states and drive of many intervals.
        starts: states at the starts of the intervals.
        drive: times and inputs of the intervals.
        at_once: number of intervals of a piece; None for :data:`PIECE`.
    """
    rows, driven = as_one_batch(starts, drive)
    length = min(at_once or PIECE, len(rows))
    firsts = [*range(0, len(rows) - length, length), len(rows) - length]
    found = [function(*piece(rows, driven, first, first + length)) for first in firsts]
    found[-1] = found[-1][len(found) * length - len(rows) :]
    return torch.cat(found).unflatten(0, starts.shape[:2])


def linearise(interval: nn.Module, names: tuple[str, ...], starts: Tensor, drive: Drive) -> Tensor:
    """[∂Φ/∂s, ∂Φ/∂w] at every interval, ``rows n_s n_s+n_w``, by a forward-mode product for each column.

    Args:
        interval: the map Φ.
        names: names of the weights w of its closure; without names the result is ∂Φ/∂s alone.
        starts: states at the starts of the intervals, ``rows n_s``.
        drive: times and inputs of the intervals.
    """
    weights = tuple(interval.get_parameter(f"closure.{name}") for name in names)
    sizes = [starts.shape[-1], *(w.numel() for w in weights)]
    basis = torch.eye(sum(sizes), dtype=starts.dtype, device=starts.device)

    def end(state: Tensor, *values: Tensor) -> Tensor:
        replaced = {f"closure.{name}": value for name, value in zip(names, values, strict=True)}
        return with_weights(interval, replaced, state, drive)

    def column(direction: Tensor) -> Tensor:
        by_state, *by_weights = direction.split(sizes)
        tangents = (part.reshape(w.shape) for part, w in zip(by_weights, weights, strict=True))
        return torch.func.jvp(end, (starts, *weights), (by_state.expand_as(starts), *tangents))[1]

    return torch.func.vmap(column, out_dims=-1)(basis)


def linearise_by_rows(interval: nn.Module, names: tuple[str, ...], starts: Tensor, drive: Drive) -> Tensor:
    """The result of :func:`linearise` by a reverse-mode product for each row: less work where n_w is far above n_s."""
    weights = {f"closure.{name}": interval.get_parameter(f"closure.{name}").detach() for name in names}

    def end(values: dict[str, Tensor], state: Tensor, *drive: Tensor) -> Tensor:
        return with_weights(interval, values, state, Drive(*drive))

    rows = torch.func.vmap(torch.func.jacrev(end, argnums=(1, 0)), in_dims=(None, 0, 0, 0, 0))
    by_state, by_weights = rows(weights, starts, *drive)
    # A weight may be one number, of no dimension.
    parts = (jacobian.reshape(*by_state.shape[:2], -1) for jacobian in by_weights.values())
    return torch.cat([by_state, *parts], -1)
