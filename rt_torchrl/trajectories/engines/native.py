r"""Engine ``native``: the exact discrete adjoint as machine code, over lanes of realisations.

One interval :math:`s_{k+1} = \Phi(s_k, x_k; w)` and its vector-Jacobian product are traced once and become machine
code. A trajectory is a loop over the intervals, and its gradient a loop back,

.. math::
    \lambda_k = \frac{\partial\Phi}{\partial s}^\top\lambda_{k+1} + \frac{\partial J}{\partial s_k}, \qquad
    \frac{dJ}{dw} = \sum_k\frac{\partial\Phi}{\partial w}^\top\lambda_{k+1},

which computes each interval again from its start. The lanes of the processor's vectors are realisations; groups of
lanes are divided among the threads of torch.
"""

from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rt_torchrl.trajectories.engines.gradient_engine import GradientEngine
from rt_torchrl.trajectories.engines.groups import Group, Signals, for_each_group, pieces
from rt_torchrl.trajectories.engines.interval import CostInterval, Drive, Interval
from rt_torchrl.trajectories.engines.parallel import Parallel
from rt_torchrl.trajectories.engines.programs import Programs, programs_of
from rt_torchrl.trajectories.engines.traced_interval import weights_of

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

    @cached_property
    def _substitute(self) -> Parallel:
        return Parallel(compiled=self._compiled)

    def takes(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> bool:
        """Whether the interval can become a program; a warning says why not."""
        return programs_of(interval, initial_state, drive) is not None

    def end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable."""
        programs = programs_of(interval, initial_state, drive)
        if programs is None:
            return self._substitute.end_states(interval, initial_state, drive)
        task = _Task(programs, interval, self.memory)
        found: Tensor = _EndStates.apply(task, initial_state, *drive, *task.learned)
        return found

    def costs(self, interval: Interval, initial_state: Tensor, drive: Drive) -> Tensor | None:
        """Sums of the running cost over all intervals, ``batch``; None if the interval cannot become a program.

        Where a gradient is wanted, it is computed in the same sweep.
        """
        costed = CostInterval(interval)
        state = torch.cat([initial_state, initial_state.new_zeros(len(initial_state), 1)], -1)
        programs = programs_of(costed, state, drive)
        if programs is None:
            return None
        task = _Task(programs, costed, self.memory)
        leaves = (state, *drive, *task.learned)
        wanted = torch.is_grad_enabled() and any(x.requires_grad for x in leaves)
        found: Tensor = _Costs.apply(task, wanted, *leaves)
        return found


class _Task:
    """Programs with the weights that they run with, and the pieces of time that they run over.

    Args:
        programs: machine code of the interval.
        interval: the interval with its weights.
        memory: bytes that a sweep may hold.
    """

    def __init__(self, programs: Programs, interval: nn.Module, memory: float):
        self.programs, self.weights, self.lanes = programs, weights_of(interval), programs.lanes.number
        self.learned = [w for w in interval.parameters() if w.requires_grad]
        self.n_s, self.n_x = programs.point.state.shape[-1], programs.width
        self.n_w = sum(w.numel() for w in self.learned)
        self.length = max(1, int(memory / torch.get_num_threads() / (16 * self.lanes * (self.n_s + self.n_x))))

    def march(self, group: Group, drive: Signals, state: np.ndarray, first: int, last: int) -> np.ndarray:
        """States ``first`` ... ``last`` of a group, ``n+1 n_s lanes``, from its state at ``first`` on."""
        states = np.empty((last - first + 1, *state.shape))
        states[0] = state
        self.programs.march()(group.packed(drive, first, last), states, self.weights, last - first)
        return states

    def sweep(
        self,
        group: Group,
        drive: Signals,
        first: int,
        last: int,
        states: np.ndarray,
        source: np.ndarray,
        out: "_Gradients",
    ) -> None:
        """Go back from interval ``last`` − 1 to ``first``, whose states at the starts are given."""
        x = group.packed(drive, first, last)
        driven = out.by_drive.shape[-1] > 0
        by_drive = np.empty((last - first, out.by_drive.shape[-1], self.lanes))
        sweep = self.programs.sweep(driven)
        sweep(x, states, source, out.costate, self.weights, by_drive, out.by_weights, last - first)
        group.scatter(by_drive, out.by_drive[first:last])

    def split(self, by_weights: np.ndarray) -> list[Tensor]:
        """Gradients of the learned weights in their own shapes."""
        parts = torch.from_numpy(by_weights).split([w.numel() for w in self.learned]) if self.learned else []
        return [part.view(w.shape) for part, w in zip(parts, self.learned, strict=True)]


class _Gradients:
    """Gradients of a group on its way back: the co-state, the sums by the weights, and those by the drive of all."""

    def __init__(self, task: _Task, by_drive: np.ndarray):
        self.costate, self.by_weights = np.zeros((task.n_s, task.lanes)), np.zeros((task.n_w, task.lanes))
        self.by_drive = by_drive


class _EndStates(torch.autograd.Function):
    """Maps (s_0, t, z, a, w) to s_1 ... s_n."""

    @staticmethod
    def forward(
        ctx: Any, task: _Task, initial_state: Tensor, t: Tensor, exogenous: Tensor, command: Tensor, *weights: Tensor
    ) -> Tensor:
        drive, n, first_states = Signals.of(Drive(t, exogenous, command)), len(t), initial_state.detach().numpy()
        ends = np.empty((n, *first_states.shape))

        def work(group: Group) -> None:
            state = group.gather(first_states[None])[0]
            for first, last in pieces(n, task.length):
                states = task.march(group, drive, state, first, last)
                group.scatter(states[1:], ends[first:last])
                state = states[-1]

        for_each_group(len(first_states), task.lanes, work)
        found = torch.from_numpy(ends)
        ctx.task = task
        # Saving the weights lets autograd notice when one is changed between forward and backward.
        ctx.save_for_backward(initial_state, t, exogenous, command, found, *weights)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cost_gradient: Tensor) -> tuple[Tensor | None, ...]:
        task: _Task = ctx.task
        initial_state, t, exogenous, command, ends = ctx.saved_tensors[:5]
        drive, sources = Signals.of(Drive(t, exogenous, command)), cost_gradient.numpy()
        starts, n = np.concatenate([initial_state.numpy()[None], ends[:-1].numpy()]), len(ends)
        driven = any(ctx.needs_input_grad[2:5])
        by_state, by_weights = np.empty((1, *starts.shape[1:])), np.zeros((starts.shape[1], task.n_w))
        by_drive = np.empty((n, starts.shape[1], task.n_x if driven else 0))

        def work(group: Group) -> None:
            out = _Gradients(task, by_drive)
            for first, last in reversed(pieces(n, task.length)):
                source = group.gather(sources[first:last]).copy()
                source[:, :, group.live :] = 0.0
                states = np.ascontiguousarray(group.gather(starts[first:last]))
                task.sweep(group, drive, first, last, states, source, out)
            group.scatter(out.costate[None], by_state)
            by_weights[group.first] = out.by_weights.sum(-1)

        for_each_group(starts.shape[1], task.lanes, work)
        along = _of_drive(torch.from_numpy(by_drive), (t, exogenous, command), driven)
        return None, torch.from_numpy(by_state[0]), *along, *task.split(by_weights.sum(0))


class _Costs(torch.autograd.Function):
    """Maps (s_0, t, z, a, w) to the last signal of s_n of each realisation, and computes its gradients at once."""

    @staticmethod
    def forward(
        ctx: Any,
        task: _Task,
        wanted: bool,
        state: Tensor,
        t: Tensor,
        exogenous: Tensor,
        command: Tensor,
        *weights: Tensor,
    ) -> Tensor:
        drive, states_0 = Signals.of(Drive(t, exogenous, command)), state.detach().numpy()
        n, batch, driven = len(t), len(states_0), wanted and any(ctx.needs_input_grad[3:6])
        costs, by_state = np.empty(batch), np.empty((1, *states_0.shape))
        by_drive, by_weights = np.empty((n, batch, task.n_x if driven else 0)), np.empty((1, batch, task.n_w))
        nothing = np.zeros((1, task.n_s, task.lanes))

        def work(group: Group) -> None:
            cuts, states = pieces(n, task.length), np.empty(0)
            starts = [group.gather(states_0[None])[0]]
            for first, last in cuts:
                states = task.march(group, drive, starts[-1], first, last)
                starts.append(states[-1].copy())
            costs[group.first : group.last] = starts.pop()[-1, : group.live]
            if not wanted:
                return
            out = _Gradients(task, by_drive)
            out.costate[-1] = 1.0
            for first, last in reversed(cuts):
                start = starts.pop()
                if last < n:  # the states of the last piece are still there
                    states = task.march(group, drive, start, first, last)
                task.sweep(group, drive, first, last, states, nothing, out)
            group.scatter(out.costate[None], by_state)
            group.scatter(out.by_weights[None], by_weights)

        for_each_group(batch, task.lanes, work)
        ctx.task, ctx.driven = task, driven
        ctx.save_for_backward(t, exogenous, command, *(torch.from_numpy(x) for x in (by_state, by_drive, by_weights)))
        return torch.from_numpy(costs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        t, exogenous, command, by_state, by_drive, by_weights = ctx.saved_tensors
        along = _of_drive(by_drive * gradient.unsqueeze(-1), (t, exogenous, command), ctx.driven)
        weights = ctx.task.split((gradient @ by_weights[0]).numpy())
        return None, None, by_state[0] * gradient.unsqueeze(-1), *along, *weights


def _of_drive(by_drive: Tensor, drive: tuple[Tensor, Tensor, Tensor], driven: bool) -> list[Tensor | None]:
    """Gradients by t, z and a, in their own shapes."""
    if not driven:
        return [None] * len(drive)
    by_t, *rest = by_drive.split([1, drive[1].shape[-1], drive[2].shape[-1]], -1)
    return [by_t.squeeze(-1).sum_to_size(drive[0].shape), *rest]
