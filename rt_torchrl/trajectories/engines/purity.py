"""Whether an interval is a function: the same answer to the same question, for each realisation alone."""

import threading
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.modules.module import register_module_forward_hook

from rt_torchrl.trajectories.engines.interval import Drive

ROWS = 4
"""Number of realisations with which an interval is asked that does not become a program."""
NUDGE = 1e-3
"""Relative change of the signals of a point, so that no two rows are equal."""
GAP = 1e-8
"""Greatest difference of two answers, relative to the largest of a signal: sums may be taken in another order."""
REMEDY = (
    "Policy, closure and plant must be pure functions: call .eval() on a module with dropout or batch normalisation; "
    "what is to be remembered must be a state of the plant, or part of the observation; random numbers belong in "
    "draw_exogenous"
)

_known: "WeakKeyDictionary[nn.Module, tuple[bool, ...]]" = WeakKeyDictionary()
"""The modes, training or evaluation, of the modules of an interval when it was found to be a function."""


class ImpureError(ValueError):
    """A policy, a closure or a plant is no function of its arguments; the message names it and says what to do."""


def require_pure(interval: nn.Module, state: Tensor, drive: Drive) -> None:
    """Refuse an interval that gives two answers to one question, or mixes realisations.

    Args:
        interval: the interval.
        state: states of several realisations, no two of which are equal.
        drive: drive of one interval of each.

    Raises:
        ImpureError: if a second answer is another one, although none but other questions were asked in between; if a
            question changes a buffer; or if the answer for a realisation depends on the others.
    """
    other = state[-1:].expand_as(state), Drive(*(x[-1:].expand_as(x) for x in drive))
    kept = {name: (buffer, buffer.clone()) for name, buffer in interval.named_buffers()}
    first = interval(state, drive).detach()
    interval(*other)
    second = interval(state, drive).detach()
    changed = [name for name, (buffer, before) in kept.items() if not _same(buffer, before)]
    with torch.no_grad():
        for name in changed:
            kept[name][0].copy_(kept[name][1])
    if changed:
        owner, _, buffer = changed[0].rpartition(".")
        raise ImpureError(f"{_named(interval, owner)} changes its buffer {buffer!r} when it is called. {REMEDY}.")
    if not _close(first, second):
        raise ImpureError(
            f"{_culprit(interval, state, drive, other)} gives something else when it is called again with the same "
            f"arguments. {REMEDY}."
        )
    try:
        alone = interval(state[-1:], Drive(*(x[-1:] for x in drive))).detach()
    except Exception as error:
        raise ImpureError(
            f"an interval of one realisation alone raises {type(error).__name__}: {str(error).rstrip('.')}; one of "
            f"{len(state)} realisations does not. Policy, closure and plant must take any number of rows."
        ) from error
    if not _close(alone, first[-1:]):
        raise ImpureError(
            "the end of an interval depends on the other realisations that are computed with it: it is "
            f"{alone[-1].tolist()} alone and {first[-1].tolist()} beside others. Rows are systems of their own: no "
            "sum, mean, norm or branch over a leading dimension in policy, closure or plant."
        )


def require_pure_once(interval: nn.Module, initial_state: Tensor, drive: Drive) -> None:
    """The same for an engine that does not trace, when an interval is new or a module of it has changed its mode.

    Raises:
        ImpureError: as :func:`require_pure`.
    """
    modes = tuple(module.training for module in interval.modules())
    if _known.get(interval) != modes:
        require_pure(interval, *rows_of(initial_state, drive, ROWS))
        _known[interval] = modes


class _Answer(nn.Module):
    """What a policy answers, as if it were an interval."""

    def __init__(self, policy: nn.Module):
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor, drive: Drive) -> Tensor:
        answer: Tensor = self.policy(observation)
        return answer


def require_pure_policy(policy: nn.Module, observation: Tensor) -> None:
    """The same of a policy alone, that steps a system, when it is new or a module of it has changed its mode.

    Args:
        policy: the policy.
        observation: observations like those that it meets, ``batch n_o``.

    Raises:
        ImpureError: as :func:`require_pure`.
    """
    modes = tuple(module.training for module in policy.modules())
    if _known.get(policy) != modes:
        nothing = observation.new_zeros(1, len(observation), 0)
        rows, drive = rows_of(observation, Drive(observation.new_zeros(1, 1), nothing, nothing), ROWS)
        require_pure(_Answer(policy), rows, drive)
        _known[policy] = modes


@torch.no_grad()
def rows_of(initial_state: Tensor, drive: Drive, count: int, sums: int = 0) -> tuple[Tensor, Drive]:
    """States and drive of one interval for a number of rows, near the initial states and at times over the whole drive.

    Behind the states are the sums of the interval, which begin with zero.
    """
    n, batch, row = len(drive.t), len(initial_state), torch.arange(count, device=initial_state.device)
    at = (row * n) // count
    t = drive.t[at, row % batch if drive.t.shape[1] > 1 else 0]
    driving = (_nudged(x[at, row % batch]) for x in (drive.exogenous, drive.command))
    return _nudged(functional.pad(initial_state.detach()[row % batch], (0, sums))), Drive(t, *driving)


def _nudged(x: Tensor) -> Tensor:
    """Rows of which no two are equal."""
    share = torch.arange(len(x), device=x.device).unsqueeze(-1) / len(x)
    return x + NUDGE * share * (x.abs() + (x == 0.0))


def _same(x: Tensor, y: Tensor) -> bool:
    return torch.equal(x, y) or bool(((x == y) | ((x != x) & (y != y))).all())


def _close(x: Tensor, y: Tensor) -> bool:
    """Whether two answers are equal but for rounding, wherever both are numbers."""
    if x.shape != y.shape:
        return False
    numbers = x.isfinite() & y.isfinite()
    gap = torch.where(numbers, (x - y).abs(), 0.0)
    size = torch.where(numbers, x.abs() + y.abs(), 0.0).amax(0)
    return bool((gap <= GAP * size).all())


def _culprit(interval: nn.Module, state: Tensor, drive: Drive, other: tuple[Tensor, Drive]) -> str:
    """The innermost module that answers one question differently; the plant if none does by itself."""
    asked: list[list[tuple[nn.Module, list[Tensor], list[Tensor]]]] = []
    here = threading.get_ident()

    def note(module: nn.Module, given: object, found: object) -> None:
        if threading.get_ident() == here:
            asked[-1].append((module, _tensors(given), _tensors(found)))

    handle = register_module_forward_hook(note)
    try:
        for question in ((state, drive), other, (state, drive)):
            asked.append([])
            interval(*question)
    finally:
        handle.remove()
    for (module, given, found), (again, *rest) in zip(asked[0], asked[2], strict=False):
        if module is again and _equal(given, rest[0]) and not _equal(found, rest[1]):
            paths = [path for path, held in interval.named_modules() if held is module]
            return _named(interval, paths[0] if paths else "")
    return _named(interval, "")


def _named(interval: nn.Module, path: str) -> str:
    """A module of an interval in words; the interval itself is what its plant makes of it."""
    short = path.replace("interval.", "")
    if short in ("", "interval"):
        plant = next((module for name, module in interval.named_modules() if name.endswith("plant")), None)
        return f"a method of plant {getattr(plant, 'name', type(interval).__name__)!r}"
    return f"{short} ({type(interval.get_submodule(path)).__name__})"


def _tensors(values: object) -> list[Tensor]:
    given = values if isinstance(values, (tuple, list)) else [values]
    return [x.clone() for x in given if isinstance(x, Tensor)]


def _equal(some: list[Tensor], others: list[Tensor]) -> bool:
    return len(some) == len(others) and all(map(_close, some, others))
