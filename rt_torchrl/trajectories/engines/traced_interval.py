"""Machine code of the recurrence of an interval and of its reverse sweep, traced and compared with torch."""

import ctypes
from itertools import chain, islice
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from rt_torchrl.programs.escapes import Escapes
from rt_torchrl.programs.machine_code import march_text, sweep_text
from rt_torchrl.programs.object_code import ObjectCode
from rt_torchrl.programs.operators import new_tracer
from rt_torchrl.programs.program import UntraceableError
from rt_torchrl.programs.tracer import Tracer
from rt_torchrl.programs.vector_functions import Lanes
from rt_torchrl.trajectories.engines.groups import Group
from rt_torchrl.trajectories.engines.interval import Drive, with_weights
from rt_torchrl.trajectories.engines.weights import Weights

POINTER = ctypes.c_void_p
MARCH = (POINTER, POINTER, POINTER, ctypes.c_int64)
SWEEP = (POINTER, POINTER, POINTER, ctypes.c_int64, *[POINTER] * 4, ctypes.c_int64)
AGREEMENT = 1e-8
"""Greatest difference between machine code and torch, relative to the largest value of a signal."""
ROUNDING = 1e-13
"""Greatest difference of gradients by weights, relative to the largest of all gradients: behind a saturated function,
such as 1 − tanh², nothing is left of a gradient but its rounding."""


class Point(NamedTuple):
    """States and drive of one interval for a few realisations, at which code is traced and compared."""

    state: Tensor
    drive: Drive

    def in_lanes(self) -> tuple[np.ndarray, np.ndarray]:
        """Drive ``1 n_x lanes`` and states ``1 n_s lanes``, one realisation in each lane."""
        n, (t, *rest) = len(self.state), (x.unsqueeze(0).numpy() for x in self.drive)
        lanes = Group(0, n, n)
        return lanes.gather(t[:, :, None], *rest), lanes.gather(self.state.unsqueeze(0).numpy())


class March:
    """Machine code of s_{k+1} = Φ(s_k, x_k; w).

    Args:
        interval: the map Φ.
        point: a point at which it is traced, and compared with torch.
        lanes: lanes of the processor.

    Raises:
        UntraceableError: if the interval cannot become a program, or the program differs from torch.
    """

    def __init__(self, interval: nn.Module, point: Point, lanes: Lanes):
        tracer = new_tracer()
        state, drive, weights = _traced_inputs(tracer, interval, point)
        with torch.no_grad(), Escapes(tracer), tracer:
            end = with_weights(interval, weights, state, drive)
        if end.shape != state.shape:
            raise UntraceableError(f"states of shape {tuple(state.shape)} become {tuple(end.shape)} in an interval")
        self.lanes, self.sizes = lanes, {"x": sum(x.numel() for x in drive), "s": state.shape[-1]}
        self._code = ObjectCode(march_text(tracer.program, tracer.outputs(end), self.sizes, lanes), "march", MARCH)
        self._compare(interval, point)

    def __call__(self, x: np.ndarray, states: np.ndarray, weights: np.ndarray, n: int) -> None:
        """Write the states 1 ... n of ``states`` (``n+1 n_s lanes``), under the drive ``x`` (``n n_x lanes``)."""
        self._code(x, states, weights, n)

    @torch.no_grad()
    def _compare(self, interval: nn.Module, point: Point) -> None:
        x, start = point.in_lanes()
        states = np.concatenate([start, start])
        self(x, states, Weights(interval).row(), 1)
        require_equal("the end state", states[1].T, interval(*point).numpy(), point.state.numpy())


class Sweep:
    """Machine code of the reverse sweep λ_k = (∂Φ/∂s)ᵀλ_{k+1} + ∂J/∂s_k, which computes each interval again.

    Args:
        interval: the map Φ.
        point: a point at which it is traced, and compared with torch.
        lanes: lanes of the processor.
        driven: whether it gives the gradients by the drive too.

    Raises:
        UntraceableError: if the interval cannot become a program, or the program differs from torch.
    """

    def __init__(self, interval: nn.Module, point: Point, lanes: Lanes, *, driven: bool):
        tracer = new_tracer()
        state, drive, weights = _traced_inputs(tracer, interval, point)
        learned = [weights[name] for name, w in interval.named_parameters() if w.requires_grad]
        costate = torch.ones_like(state)
        tracer.input(costate, "l")
        parts = [state], [*drive] if driven else [], learned
        leaves = [leaf.requires_grad_() for part in parts for leaf in part]
        with torch.enable_grad(), Escapes(tracer), tracer:
            end = with_weights(interval, weights, state, drive)
            found = [torch.zeros_like(leaf) for leaf in leaves]
            if end.requires_grad:
                found = torch.autograd.grad(end, leaves, costate, allow_unused=True, materialize_grads=True)
        values = map(tracer.outputs, found)
        outputs = [[*chain.from_iterable(islice(values, len(part)))] for part in parts]
        self.lanes, self.driven = lanes, driven
        self.sizes = {"x": sum(x.numel() for x in drive), "s": state.shape[-1]}
        self._code = ObjectCode(sweep_text(tracer.program, outputs, self.sizes, lanes), "sweep", SWEEP)
        self._compare(interval, point)

    def __call__(self, x: np.ndarray, states: np.ndarray, source: np.ndarray, *others: np.ndarray | int) -> None:
        """Replace the co-state of the end (``n_s lanes``) by that of the start, and give the gradients.

        Args:
            x: drive, ``n n_x lanes``.
            states: states at the starts of the intervals, ``n n_s lanes``.
            source: ∂J/∂s at the end of every interval, ``n n_s lanes``, or one row that serves all.
            others: the co-state; all weights of the interval; the gradients by the drive, ``n n_x lanes``, which stay
                untouched unless ``driven``; the gradients by the learned weights, ``n_w lanes``, which are added to;
                the number n of intervals.
        """
        self._code(x, states, source, int(len(source) > 1), *others)

    def _compare(self, interval: nn.Module, point: Point) -> None:
        weights, (x, states) = Weights(interval), point.in_lanes()
        costate = 1.0 + 0.1 * np.arange(states[0].size, dtype=float).reshape(states[0].shape)
        by_state, by_drive = costate.copy(), np.zeros_like(x)
        by_weights = np.zeros((sum(weights.sizes), self.lanes.number))
        self(x, states, np.zeros_like(states), by_state, weights.row(), by_drive, by_weights, 1)
        state, *drive = (x.clone().requires_grad_() for x in (point.state, *point.drive))
        with torch.enable_grad():
            end, by_end, leaves = interval(state, Drive(*drive)), torch.from_numpy(costate.T), [state, *drive]
            leaves += weights.learned
            wanted = torch.autograd.grad(end, leaves, by_end, allow_unused=True, materialize_grads=True)
        exact = [wanted[0], torch.cat([wanted[1].unsqueeze(-1), *wanted[2:4]], -1), *wanted[4:]]
        found = [by_state.T, by_drive[0].T if self.driven else exact[1], *weights.split(by_weights.sum(-1))]
        names = ["state", "drive", *(name for name, w in interval.named_parameters() if w.requires_grad)]
        finite = (x[x.isfinite()].abs() for x in exact)
        floor = ROUNDING / AGREEMENT * max(x.max().item() if x.numel() else 0.0 for x in finite)
        for name, part, exactly in zip(names, found, exact, strict=True):
            require_equal(f"the gradient by {name}", np.asarray(part), exactly.numpy(), np.full(exactly.shape, floor))


def require_equal(what: str, found: np.ndarray, exact: np.ndarray, scale: np.ndarray) -> None:
    """Refuse machine code that differs from torch.

    Raises:
        UntraceableError: if a number differs by more than :data:`AGREEMENT` of the largest finite number of its column.
    """
    sizes = np.abs(np.where(np.isfinite(exact), exact, 0.0)) + np.abs(np.where(np.isfinite(scale), scale, 0.0))
    equal = np.isclose(found, exact, rtol=0.0, atol=AGREEMENT * sizes.max(0, initial=0.0) + 1e-300, equal_nan=True)
    if not equal.all():
        raise UntraceableError(
            f"{what} differs from what torch computes, for example {found[~equal][0]} instead of {exact[~equal][0]}. A "
            "number has left torch where tracing cannot follow it, such as by .numpy()"
        )


def _traced_inputs(tracer: Tracer, interval: nn.Module, point: Point) -> tuple[Tensor, Drive, dict[str, Tensor]]:
    """State, drive and weights as inputs of a program, of the last realisation.

    A number that code takes from the first realisation of all then differs from the one that was traced.
    """
    state, drive = point.state[-1:].clone(), Drive(*(x[-1:].clone() for x in point.drive))
    tracer.input(state, "s")
    for x in drive:
        tracer.input(x, "x")
    weights = {}
    for name, w in interval.named_parameters():
        if w.dtype != torch.float64:
            raise UntraceableError(f"{name} is in {w.dtype}; trajectories need torch.float64")
        weights[name] = w.detach().clone()
        tracer.weight(weights[name])
    return state, drive, weights
