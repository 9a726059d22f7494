r"""Engine ``parallel``: the exact discrete adjoint, parallel over time.

With one interval as :math:`s_{k+1} = \Phi(s_k, x_k; w)`, the gradient of a cost :math:`J(s_0, \dots, s_n)` is

.. math::
    A_k = \frac{\partial\Phi}{\partial s}(s_k, x_k), \qquad
    \lambda_n = \frac{\partial J}{\partial s_n}, \quad
    \lambda_k = A_k^\top\lambda_{k+1} + \frac{\partial J}{\partial s_k}, \qquad
    \frac{dJ}{dw} = \sum_k \lambda_{k+1}^\top\frac{\partial\Phi}{\partial w}(s_k, x_k).

Only the recurrence of the states and the (linear) one of λ are sequential. The Jacobians of all intervals and all
trajectories are one batched call, and so is the sum over k.
"""

from functools import partial

import torch
from hoptorch.scan import scan
from torch import Tensor
from torch.autograd.function import once_differentiable

from rt_torchrl.trajectories.engines.compilation import compiled_if, marked_dynamic, plain
from rt_torchrl.trajectories.engines.interval import Drive, Interval
from rt_torchrl.trajectories.engines.linearisation import as_one_batch, linearise, over_all
from rt_torchrl.trajectories.engines.recurrence import march, march_by_scan


class ParallelAdjoint:
    """See the module.

    Args:
        compiled: compile the two recurrences, the Jacobians and the final product.
    """

    def __init__(self, *, compiled: bool):
        self.march = compiled_if(compiled, march_by_scan, march)
        self.linearise = compiled_if(compiled, linearise)
        self.costates = compiled_if(compiled, costates_by_scan, costates)
        self.intervals = compiled_if(compiled, _all_intervals)

    def end_states(self, interval: Interval, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable."""
        weights = [w for w in interval.parameters() if w.requires_grad]
        return _DiscreteAdjoint.apply(self, interval, initial_state, *drive, *weights)


class _DiscreteAdjoint(torch.autograd.Function):
    """Maps (s_0, t, z, a, w) to s_1 ... s_n; the engine and the interval are passed along for their maps."""

    @staticmethod
    def forward(ctx, engine, interval, initial_state, t, exogenous, command, *weights):
        ends = engine.march(interval, initial_state, Drive(t, exogenous, command))
        ctx.engine, ctx.interval = engine, interval
        # Saving the weights lets autograd notice when one is changed between forward and backward.
        ctx.save_for_backward(initial_state, t, exogenous, command, ends, *weights)
        return ends

    @staticmethod
    @once_differentiable
    def backward(ctx, cost_gradient):
        initial_state, t, exogenous, command, ends, *weights = ctx.saved_tensors
        starts, drive = torch.cat([initial_state.unsqueeze(0), ends[:-1]]), Drive(t, exogenous, command)
        jacobians = over_all(partial(ctx.engine.linearise, ctx.interval, ()), starts, drive)
        sources = marked_dynamic(plain(cost_gradient), 1)
        costates = ctx.engine.costates(marked_dynamic(jacobians[1:], 1), sources)  # λ_1 ... λ_n
        wanted = ctx.needs_input_grad[3:]  # t, exogenous, command and the weights
        with torch.enable_grad():
            inputs = [x.detach().requires_grad_(need) for x, need in zip(drive, wanted, strict=False)] + weights
            out = ctx.engine.intervals(ctx.interval, *as_one_batch(starts, Drive(*inputs[:3])))
        leaves = [x for x, need in zip(inputs, wanted, strict=True) if need]
        found = iter(torch.autograd.grad(out, leaves, costates.flatten(0, 1), allow_unused=True) if leaves else ())
        first = torch.einsum("bji,bj->bi", jacobians[0], costates[0]) if ctx.needs_input_grad[2] else None
        return None, None, first, *(next(found) if need else None for need in wanted)


def _all_intervals(interval: Interval, starts: Tensor, drive: Drive) -> Tensor:
    """Φ at every interval at once."""
    return interval(starts, drive)


def costates(jacobians: Tensor, cost_gradient: Tensor) -> Tensor:
    """λ_1 ... λ_n from A_1 ... A_{n−1} and ∂J/∂s_1 ... ∂J/∂s_n, by a loop."""
    costate = cost_gradient[-1]
    reversed_costates = [costate]
    for transition, source in zip(jacobians.flip(0), cost_gradient[:-1].flip(0), strict=True):
        costate = torch.einsum("bji,bj->bi", transition, costate) + source
        reversed_costates.append(costate)
    return torch.stack(reversed_costates).flip(0)


def costates_by_scan(jacobians: Tensor, cost_gradient: Tensor) -> Tensor:
    """The same by one ``scan``, for the compiler."""

    def body(costate, x):
        transition, source = x
        costate = ((transition * costate.unsqueeze(-1)).sum(-2) + source).contiguous()
        return costate, costate.clone()

    last = plain(cost_gradient[-1])
    earlier = scan(body, last, (jacobians.flip(0), cost_gradient[:-1].flip(0)))[1]
    return torch.cat([earlier.flip(0), last.unsqueeze(0)])
