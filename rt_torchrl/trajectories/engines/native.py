r"""Engine ``native``: the exact discrete adjoint as machine code, over lanes of realisations.

One interval :math:`s_{k+1} = \Phi(s_k, x_k; w)` and its vector-Jacobian product are traced once and become machine
code. A trajectory is a loop over the intervals, and its gradient a loop back,

.. math::
    \lambda_k = \frac{\partial\Phi}{\partial s}^\top\lambda_{k+1} + \frac{\partial J}{\partial s_k}, \qquad
    \frac{dJ}{dw} = \sum_k\frac{\partial\Phi}{\partial w}^\top\lambda_{k+1},

which computes each interval again from its start. The lanes of the processor's vectors are realisations; groups of
lanes are divided among the threads of torch.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rt_torchrl.trajectories.engines.code import (
    Group,
    Inputs,
    IntervalCode,
    code_of,
    for_each_group,
    signals_of,
)
from rt_torchrl.trajectories.engines.interval import Autograd, CostInterval, Drive, GradientEngine
from rt_torchrl.trajectories.engines.parallel import Parallel


class Native(GradientEngine):
    """Computes trajectories and their exact discrete adjoint by machine code; the module describes it.

    Where an interval cannot become a program, the engine ``autograd`` takes its place without compilation, with one
    warning for each kind of interval: it executes any code as it is written. The engine ``parallel`` evaluates many
    intervals at once, so that a Python branch could be another one; it serves other devices than the CPU alone.
    """

    def end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable."""
        if initial_state.device.type != "cpu":
            return Parallel().end_states(interval, initial_state, drive)
        ends = self.native_end_states(interval, initial_state, drive)
        return Autograd().end_states(interval, initial_state, drive) if ends is None else ends

    def native_end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor | None:
        """The same by machine code; None, with a warning that says why, if the interval cannot become a program."""
        task = self._task(interval, initial_state, drive)
        ends: Tensor | None = None if task is None else _EndStates.apply(task, *task.leaves)
        return ends

    def costs(self, interval: CostInterval, initial_state: Tensor, drive: Drive) -> Tensor | None:
        """Means of the running cost over all intervals, ``batch``; None if the interval cannot become a program.

        Where a gradient is wanted, it is computed in the same sweep.
        """
        task = self._task(interval, initial_state, drive)
        costs: Tensor | None = None if task is None else _Costs.apply(task, torch.is_grad_enabled(), *task.leaves)
        return costs

    def _task(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> "_Task | None":
        compiled = code_of(interval, initial_state, drive)
        return compiled and _Task(*compiled, initial_state, drive)


class _Task:
    """Trajectories that are to be computed.

    Args:
        code: machine code of the interval.
        inputs: weights and buffers of the interval.
        initial_state: initial states; further states of the program begin with zero.
        drive: drive of all intervals.
    """

    def __init__(self, code: IntervalCode, inputs: Inputs, initial_state: Tensor, drive: Drive):
        self.code, self.inputs, self.lanes = code, inputs, code.lanes.number
        self.leaves, self.row = (initial_state, *drive, *inputs.learned), inputs.row()
        self.initial_state, self.n, self.batch = initial_state.detach().numpy(), len(drive.t), len(initial_state)
        self.drive = [drive.t.unsqueeze(-1), drive.exogenous, drive.command]
        self.signals = signals_of(self.drive)

    def march(self, group: Group) -> np.ndarray:
        """The states ``n+1 n_s lanes`` of a group."""
        states = np.empty((self.n + 1, self.code.sizes["s"], self.lanes))
        states[0] = 0.0
        states[0, : self.initial_state.shape[1]] = group.gather(self.initial_state[None])[0]
        self.code.march(self.signals, group.first, group.last - 1, states, self.row, self.n)
        return states


class _Gradients:
    """Gradients by (s_0, t, z, a, w), of each realisation.

    Args:
        task: the trajectories.
        driven: whether those by t, z and a are wanted.
    """

    def __init__(self, task: _Task, *, driven: bool):
        self._task = task
        self._by_state = np.empty((1, *task.initial_state.shape))
        self._by_weights = np.empty((1, task.batch, sum(task.inputs.sizes)))
        self._by_drive = np.empty((task.n, task.batch, task.code.sizes["x"])) if driven else None
        self._sweep = task.code.sweeps[driven]

    def sweep(self, group: Group, states: np.ndarray, source: np.ndarray, *, last: float = 0.0) -> None:
        """Go back over the trajectories of a group.

        Args:
            group: the group.
            states: states at the starts of all intervals, ``n n_s lanes``.
            source: ∂J/∂s at their ends, or one row that serves all.
            last: ∂J/∂s of the last signal at the end of all, beside that of the source.
        """
        task = self._task
        costate = np.zeros((task.code.sizes["s"], group.lanes))
        by_weights = np.zeros((self._by_weights.shape[-1], group.lanes))
        costate[-1] = last
        by_drive = np.empty((task.n, task.code.sizes["x"], group.lanes) if self._by_drive is not None else 0)
        arrays = states, source, int(len(source) > 1), costate, task.row, by_drive, by_weights
        self._sweep(task.signals, group.first, group.last - 1, *arrays, task.n)
        if self._by_drive is not None:
            group.scatter(by_drive, self._by_drive)
        group.scatter(costate[None, : self._by_state.shape[-1]], self._by_state)
        group.scatter(by_weights[None], self._by_weights)

    def weighed(self, factor: np.ndarray) -> list[Tensor | None]:
        """The gradients of the sum of all realisations, each with its factor, in the shapes of the leaves."""
        along: list[Tensor | None] = [None] * 3
        if self._by_drive is not None:
            by_drive = torch.from_numpy(self._by_drive * factor[:, None])
            by_t, *rest = by_drive.split([signal.shape[-1] for signal in self._task.drive], -1)
            along = [by_t.squeeze(-1).sum_to_size(self._task.leaves[1].shape), *rest]
        by_state = torch.from_numpy(self._by_state[0] * factor[:, None])
        return [by_state, *along, *self._task.inputs.split(np.einsum("i,ij->j", factor, self._by_weights[0]))]


class _EndStates(torch.autograd.Function):
    """Maps (s_0, t, z, a, w) to s_1 ... s_n."""

    @staticmethod
    def forward(ctx: Any, task: _Task, *leaves: Tensor) -> Tensor:
        ends = np.empty((task.n, *task.initial_state.shape))

        for_each_group(task.batch, task.lanes, lambda group: group.scatter(task.march(group)[1:], ends))
        states = torch.from_numpy(ends)
        ctx.task = task
        # What is saved tells autograd when it is changed between forward and backward, the weights too.
        ctx.save_for_backward(states, *leaves)
        return states

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cost_gradient: Tensor) -> tuple[Tensor | None, ...]:
        task, ends, sources = ctx.task, ctx.saved_tensors[0].numpy(), cost_gradient.numpy()
        starts = np.concatenate([task.initial_state[None], ends[:-1]])
        gradients = _Gradients(task, driven=any(ctx.needs_input_grad[2:5]))

        def work(group: Group) -> None:
            gradients.sweep(group, group.gather(starts), group.gather(sources))

        for_each_group(task.batch, task.lanes, work)
        return None, *gradients.weighed(np.ones(task.batch))


class _Costs(torch.autograd.Function):
    """Maps (s_0, t, z, a, w) to the last signal of s_n by n of each realisation, and computes its gradients at once."""

    @staticmethod
    def forward(ctx: Any, task: _Task, enabled: bool, *leaves: Tensor) -> Tensor:
        costs, nothing = np.empty(task.batch), np.zeros((1, task.code.sizes["s"], task.lanes))
        differentiated, driven = enabled and any(ctx.needs_input_grad), any(ctx.needs_input_grad[3:6])
        gradients = ctx.gradients = _Gradients(task, driven=driven) if differentiated else None

        def work(group: Group) -> None:
            states = task.march(group)
            costs[group.first : group.last] = states[-1, -1, : group.live]
            if gradients is not None:
                gradients.sweep(group, states, nothing, last=1.0)

        for_each_group(task.batch, task.lanes, work)
        ctx.n = task.n
        return torch.from_numpy(costs / task.n)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, *ctx.gradients.weighed(gradient.numpy() / ctx.n)
