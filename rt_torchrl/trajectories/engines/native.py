r"""Engine ``native``: the exact discrete adjoint as machine code, over lanes of realisations.

One interval :math:`s_{k+1} = \Phi(s_k, x_k; w)` and its vector-Jacobian product are traced once and become machine
code. A trajectory is a loop over the intervals, and its gradient a loop back,

.. math::
    \lambda_k = \frac{\partial\Phi}{\partial s}^\top\lambda_{k+1} + \frac{\partial J}{\partial s_k}, \qquad
    \frac{dJ}{dw} = \sum_k\frac{\partial\Phi}{\partial w}^\top\lambda_{k+1},

which computes each interval again from its start. The lanes of the processor's vectors are realisations; groups of
lanes are divided among the threads of torch.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rt_torchrl.trajectories.engines.gradient_engine import GradientEngine
from rt_torchrl.trajectories.engines.groups import Group, for_each_group
from rt_torchrl.trajectories.engines.interval import CostInterval, Drive, Interval
from rt_torchrl.trajectories.engines.parallel import Parallel
from rt_torchrl.trajectories.engines.programs import Programs, programs_of
from rt_torchrl.trajectories.engines.weights import Weights

MEMORY = 2.0**30
"""Bytes of states and drive that a sweep holds at once; of longer trajectories it holds checkpoints in time."""
LEAST_MEMORY = 2.0**20


class Native(GradientEngine):
    """Computes trajectories and their exact discrete adjoint by machine code; the module describes it.

    Where an interval cannot become a program, or is not on the CPU, the engine ``parallel`` takes its place, with one
    warning for each kind of interval.

    Args:
        compiled: whether the engine that takes its place compiles.
        memory: bytes that a sweep may hold.

    Raises:
        ValueError: if the memory is below a mebibyte.
    """

    own_scheme: ClassVar[bool] = True
    start_per_realisation: ClassVar[bool] = True

    def __init__(self, *, compiled: bool, memory: float = MEMORY):
        if not memory >= LEAST_MEMORY:
            raise ValueError(f"memory={memory} bytes of engine 'native' must be at least {LEAST_MEMORY:.0f}.")
        self.memory, self._compiled = memory, compiled
        self._costed: CostInterval | None = None

    @cached_property
    def _substitute(self) -> Parallel:
        return Parallel(compiled=self._compiled)

    def end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable."""
        found = self.own_end_states(interval, initial_state, drive)
        return self._substitute.end_states(interval, initial_state, drive) if found is None else found

    def own_end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor | None:
        """The same by machine code; None, with a warning that says why, if the interval cannot become a program."""
        found = programs_of(interval, initial_state, drive)
        if found is None:
            return None
        task = _Task(*found, initial_state, drive, self.memory)
        ends: Tensor = _EndStates.apply(task, initial_state, *drive, *task.weights.learned)
        return ends

    def costs(self, interval: Interval, initial_state: Tensor, drive: Drive) -> Tensor | None:
        """Sums of the running cost over all intervals, ``batch``; None if the interval cannot become a program.

        Where a gradient is wanted, it is computed in the same sweep.
        """
        if self._costed is None or self._costed.interval is not interval:
            self._costed = CostInterval(interval)
        state = nn.functional.pad(initial_state, (0, 1))
        found = programs_of(self._costed, state, drive)
        if found is None:
            return None
        task = _Task(*found, state, drive, self.memory)
        leaves = (state, *drive, *task.weights.learned)
        wanted = torch.is_grad_enabled() and any(x.requires_grad for x in leaves)
        costs: Tensor = _Costs.apply(task, wanted, *leaves)
        return costs


class _Task:
    """Trajectories that are to be computed, in pieces of time.

    Args:
        programs: machine code of the interval.
        weights: weights of the interval.
        initial_state: initial states.
        drive: drive of all intervals.
        memory: bytes that a sweep may hold.
    """

    def __init__(self, programs: Programs, weights: Weights, initial_state: Tensor, drive: Drive, memory: float):
        self.programs, self.weights, self.lanes = programs, weights, programs.lanes.number
        self.row, self.n_w = weights.row(), sum(weights.sizes)
        self.initial_state, self.n = initial_state.detach().numpy(), len(drive.t)
        t = drive.t.unsqueeze(-1).expand(-1, len(initial_state), 1)
        self.drive = [x.detach().numpy() for x in (t, *drive[1:])]
        self.n_s, self.n_x = (programs.march.sizes[name] for name in "sx")
        length = max(1, int(memory / torch.get_num_threads() / (16 * self.lanes * (self.n_s + self.n_x))))
        self.pieces = [slice(first, min(first + length, self.n)) for first in range(0, self.n, length)]

    def start(self, group: Group) -> np.ndarray:
        """The initial states of a group, ``n_s lanes``."""
        return group.gather(self.initial_state[None])[0]

    def march(self, group: Group, piece: slice, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Drive ``n n_x lanes`` and states ``n+1 n_s lanes`` of a piece, from the state at its start on."""
        x = self.driving(group, piece)
        states = np.empty((len(x) + 1, *state.shape))
        states[0] = state
        self.programs.march(x, states, self.row, len(x))
        return x, states

    def driving(self, group: Group, piece: slice) -> np.ndarray:
        """The drive of a group in a piece, ``n n_x lanes``."""
        return group.gather(*(signal[piece] for signal in self.drive))

    def sweep(
        self, group: Group, piece: slice, marched: Sequence[np.ndarray], found: Sequence[np.ndarray | None]
    ) -> None:
        """Go back over a piece of a group.

        Args:
            group: the group.
            piece: the piece.
            marched: drive and states of the piece, and ∂J/∂s at the ends of its intervals.
            found: the co-state, ``n_s lanes``, which becomes that of the start; gradients by the weights, ``n_w
                lanes``, which are added to; gradients by the drive of all groups, ``n batch n_x``, or None to leave
                them.
        """
        x, (costate, by_weights, by_drive) = marched[0], found
        along = np.empty(x.shape if by_drive is not None else 0)
        sweep = self.programs.sweeps[by_drive is not None]
        sweep(*marched, costate, self.row, along, by_weights, len(x))
        if by_drive is not None:
            group.scatter(along, by_drive[piece])

    def way_back(self) -> tuple[np.ndarray, np.ndarray]:
        """Co-state and gradients by the weights of a group, all zero."""
        return np.zeros((self.n_s, self.lanes)), np.zeros((self.n_w, self.lanes))

    def of_drive(self, by_drive: Tensor, t: Tensor) -> list[Tensor]:
        """Gradients by t, z and a, in their own shapes, of those by the drive, ``n batch n_x``."""
        by_t, *rest = by_drive.split([signal.shape[-1] for signal in self.drive], -1)
        return [by_t.squeeze(-1).sum_to_size(t.shape), *rest]


class _EndStates(torch.autograd.Function):
    """Maps (s_0, t, z, a, w) to s_1 ... s_n."""

    @staticmethod
    def forward(ctx: Any, task: _Task, *leaves: Tensor) -> Tensor:
        ends = np.empty((task.n, *task.initial_state.shape))

        def work(group: Group) -> None:
            state = task.start(group)
            for piece in task.pieces:
                _, states = task.march(group, piece, state)
                group.scatter(states[1:], ends[piece])
                state = states[-1]

        for_each_group(ends.shape[1], task.lanes, work)
        found = torch.from_numpy(ends)
        ctx.task = task
        # What is saved tells autograd when it is changed between forward and backward, the weights too.
        ctx.save_for_backward(found, *leaves)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cost_gradient: Tensor) -> tuple[Tensor | None, ...]:
        task, (ends, _, t, *_) = ctx.task, ctx.saved_tensors
        starts, sources = np.concatenate([task.initial_state[None], ends[:-1].numpy()]), cost_gradient.numpy()
        by_state, by_weights = np.empty((1, *starts.shape[1:])), np.zeros((starts.shape[1], task.n_w))
        by_drive = np.empty((*starts.shape[:2], task.n_x)) if any(ctx.needs_input_grad[2:5]) else None

        def work(group: Group) -> None:
            costate, weighted = task.way_back()
            for piece in reversed(task.pieces):
                source = group.gather(sources[piece])
                source[:, :, group.live :] = 0.0
                marched = task.driving(group, piece), group.gather(starts[piece]), source
                task.sweep(group, piece, marched, (costate, weighted, by_drive))
            group.scatter(costate[None], by_state)
            by_weights[group.first] = weighted.sum(-1)

        for_each_group(starts.shape[1], task.lanes, work)
        along = [None] * 3 if by_drive is None else task.of_drive(torch.from_numpy(by_drive), t)
        return None, torch.from_numpy(by_state[0]), *along, *task.weights.split(by_weights.sum(0))


class _Costs(torch.autograd.Function):
    """Maps (s_0, t, z, a, w) to the last signal of s_n of each realisation, and computes its gradients at once."""

    @staticmethod
    def forward(ctx: Any, task: _Task, wanted: bool, *leaves: Tensor) -> Tensor:
        batch, driven = len(task.initial_state), wanted and any(ctx.needs_input_grad[3:6])
        costs, by_state = np.empty(batch), np.empty((1, *task.initial_state.shape))
        by_weights = np.empty((1, batch, task.n_w))
        by_drive = np.empty((task.n, batch, task.n_x)) if driven else None
        nothing = np.zeros((1, task.n_s, task.lanes))

        def work(group: Group) -> None:
            starts = [task.start(group)]
            for piece in task.pieces:
                x, states = task.march(group, piece, starts[-1])
                starts.append(states[-1].copy())
            costs[group.first : group.last] = starts.pop()[-1, : group.live]
            if not wanted:
                return
            costate, weighted = task.way_back()
            costate[-1] = 1.0
            for piece in reversed(task.pieces):
                start = starts.pop()
                if piece.stop < task.n:  # those of the last piece are still there
                    x, states = task.march(group, piece, start)
                task.sweep(group, piece, (x, states, nothing), (costate, weighted, by_drive))
            group.scatter(costate[None], by_state)
            group.scatter(weighted[None], by_weights)

        for_each_group(batch, task.lanes, work)
        ctx.task, ctx.t, ctx.found = task, leaves[1], [by_state[0], by_weights[0], by_drive]
        return torch.from_numpy(costs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        task, factor = ctx.task, gradient.numpy()
        by_state, by_weights, by_drive = ctx.found
        along = [None] * 3
        if by_drive is not None:
            along = task.of_drive(torch.from_numpy(by_drive * factor[:, None]), ctx.t)
        state = torch.from_numpy(by_state * factor[:, None]) if ctx.needs_input_grad[2] else None
        return None, None, state, *along, *task.weights.split(factor @ by_weights)
