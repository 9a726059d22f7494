"""Machine code of the recurrence of an interval and of its reverse sweep, traced and compared with torch."""

import ctypes
from collections.abc import Sequence
from itertools import chain, islice
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from rt_torchrl.programs.escapes import Escapes
from rt_torchrl.programs.machine_code import march_text, sweep_text
from rt_torchrl.programs.object_code import ObjectCode
from rt_torchrl.programs.operators import new_tracer
from rt_torchrl.programs.outside import Executed, guards_of
from rt_torchrl.programs.program import UntraceableError
from rt_torchrl.programs.tracer import STRAIGHT, Tracer
from rt_torchrl.programs.vector_functions import Lanes
from rt_torchrl.trajectories.engines.groups import Group, signals_of
from rt_torchrl.trajectories.engines.interval import Drive, with_weights
from rt_torchrl.trajectories.engines.weights import Weights

POINTER = ctypes.c_void_p
DRIVE = (POINTER, *[ctypes.c_int64] * 3)
MARCH = (*DRIVE, POINTER, POINTER, ctypes.c_int64)
SWEEP = (*DRIVE, POINTER, POINTER, ctypes.c_int64, *[POINTER] * 4, ctypes.c_int64)
AGREEMENT = 1e-8
"""Greatest difference between machine code and torch, relative to the largest value of a signal."""
ROUNDING = 1e-13
"""Greatest difference of gradients by weights, relative to the largest of all gradients: behind a saturated function,
such as 1 − tanh², nothing is left of a gradient but its rounding."""


class UncomparedError(Exception):
    """Where torch finds no numbers, machine code has nothing to be compared with."""


class Point(NamedTuple):
    """States and drive of one interval for a few realisations, at which code is traced and compared."""

    state: Tensor
    drive: Drive

    def in_lanes(self) -> tuple[tuple[np.ndarray, int, int, int], np.ndarray]:
        """Drive, as machine code takes it, and states ``1 n_s lanes``, one realisation in each lane."""
        lanes, (t, *rest) = Group(0, len(self.state), len(self.state)), self.drive
        signals = signals_of(x.unsqueeze(0) for x in (t.unsqueeze(-1), *rest))
        return (signals, 0, lanes.last - 1, 0), lanes.gather(self.state.unsqueeze(0).numpy())


class Programs:
    """The machine code of one kind of interval: ``march(x, s, w, n)`` and, once it is prepared, the reverse sweep.

    :mod:`rt_torchrl.programs.machine_code` describes both functions.

    Args:
        interval: the map Φ; its attribute ``straight``, if it has one, is that of the :class:`Tracer`.
        point: a point at which it is traced, and compared with torch.
        lanes: lanes of the processor.

    Raises:
        UntraceableError: if the interval cannot become a program, or the program differs from torch.
        UncomparedError: if torch finds no numbers at the point, such as with weights that are not finite.
    """

    def __init__(self, interval: nn.Module, point: Point, lanes: Lanes):
        self.point, self.lanes = point, lanes
        self.sweeps: dict[bool, ObjectCode] = {}
        """The reverse sweeps that have been prepared, without and with the gradients by the drive."""
        tracer = new_tracer(getattr(interval, "straight", STRAIGHT))
        state, drive, weights = _traced_inputs(tracer, interval, point)
        with torch.no_grad(), Escapes(tracer), tracer:
            end = with_weights(interval, weights, state, drive)
        if end.shape != state.shape:
            raise UntraceableError(f"states of shape {tuple(state.shape)} become {tuple(end.shape)} in an interval")
        self.sizes = {"x": sum(x.numel() for x in drive), "s": state.shape[-1]}
        self.march = ObjectCode(march_text(tracer.program, tracer.outputs(end), self.sizes, lanes), "march", MARCH)
        x, start = point.in_lanes()
        states = np.concatenate([start, start])
        self.march(*x, states, Weights(interval).row(), 1)
        executed = Executed()
        with torch.no_grad(), executed.noted():
            exact = interval(*point).numpy()
        self.guards = guards_of(interval, executed)
        """Constants outside of the interval that its code has read."""
        require_equal("the end state", states[1].T, exact, point.state.numpy())

    def prepare_sweep(self, interval: nn.Module, driven: bool) -> None:
        """Make the reverse sweep of an interval of this kind, unless it is there.

        Args:
            interval: the interval.
            driven: whether the sweep gives the gradients by the drive too.

        Raises:
            UntraceableError: if it cannot become a program, or the program differs from torch.
            UncomparedError: if torch finds no numbers at the point.
        """
        if driven in self.sweeps:
            return
        tracer = new_tracer()
        state, drive, weights = _traced_inputs(tracer, interval, self.point)
        costate = torch.ones_like(state)
        tracer.input(costate, "l")
        learned = [weights[name] for name, w in interval.named_parameters() if w.requires_grad]
        parts = [state], [*drive] if driven else [], learned
        leaves = [leaf.requires_grad_() for part in parts for leaf in part]
        with torch.enable_grad(), Escapes(tracer), tracer:
            found = _gradients(with_weights(interval, weights, state, drive), leaves, costate)
        values = map(tracer.outputs, found)
        outputs = [[*chain.from_iterable(islice(values, len(part)))] for part in parts]
        code = ObjectCode(sweep_text(tracer.program, outputs, self.sizes, self.lanes), "sweep", SWEEP)
        self._compare_sweep(code, interval, driven)
        self.sweeps[driven] = code

    def _compare_sweep(self, sweep: ObjectCode, interval: nn.Module, driven: bool) -> None:
        weights, (x, states) = Weights(interval), self.point.in_lanes()
        costate = 1.0 + 0.1 * np.arange(states[0].size, dtype=float).reshape(states[0].shape)
        by_state, by_drive = costate.copy(), np.zeros((1, self.sizes["x"], self.lanes.number))
        by_weights = np.zeros((sum(weights.sizes), self.lanes.number))
        sweep(*x, states, np.zeros_like(states), 0, by_state, weights.row(), by_drive, by_weights, 1)
        leaves = [x.clone().requires_grad_() for x in (self.point.state, *self.point.drive)]
        executed = Executed()
        with torch.enable_grad(), executed.noted():
            end = interval(leaves[0], Drive(*leaves[1:]))
            state, t, *rest = _gradients(end, [*leaves, *weights.learned], torch.from_numpy(costate.T))
        self.guards = guards_of(interval, executed, self.guards)
        exact = [state, torch.cat([t.unsqueeze(-1), *rest[:2]], -1), *rest[2:]]
        found = [by_state.T, by_drive[0].T if driven else exact[1], *weights.split(by_weights.sum(-1))]
        largest = [x[x.isfinite()].abs().amax().item() for x in exact if x.isfinite().any()]
        if not largest:
            raise UncomparedError
        floor = ROUNDING / AGREEMENT * max(largest)
        names = ["state", "drive", *(name for name, w in interval.named_parameters() if w.requires_grad)]
        for name, part, exactly in zip(names, found, exact, strict=True):
            require_equal(f"the gradient by {name}", np.asarray(part), exactly.numpy(), np.full(exactly.shape, floor))


def _gradients(end: Tensor, leaves: list[Tensor], costate: Tensor) -> Sequence[Tensor]:
    """The products of the co-state of an end with its Jacobians by the leaves."""
    if not end.requires_grad:
        return [torch.zeros_like(leaf) for leaf in leaves]
    return torch.autograd.grad(end, leaves, costate, allow_unused=True, materialize_grads=True)


def require_equal(what: str, found: np.ndarray, exact: np.ndarray, scale: np.ndarray) -> None:
    """Refuse machine code that differs from torch.

    Raises:
        UntraceableError: if a number differs by more than :data:`AGREEMENT` of the largest finite number of its column.
        UncomparedError: if it differs only where torch finds no numbers.
    """
    sizes = np.abs(np.where(np.isfinite(exact), exact, 0.0)) + np.abs(np.where(np.isfinite(scale), scale, 0.0))
    equal = np.isclose(found, exact, rtol=0.0, atol=AGREEMENT * sizes.max(0, initial=0.0) + 1e-300, equal_nan=True)
    wrong = ~equal & np.isfinite(exact)
    if wrong.any():
        raise UntraceableError(
            f"{what} differs from what torch computes, for example {found[wrong][0]} instead of {exact[wrong][0]}. A "
            "number has left torch where tracing cannot follow it, such as by .numpy()"
        )
    if not equal.all():
        raise UncomparedError


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
