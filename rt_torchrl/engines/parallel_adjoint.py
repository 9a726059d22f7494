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

from collections.abc import Callable
from functools import partial

import torch
from hoptorch.scan import scan
from torch import Tensor
from torch.autograd.function import once_differentiable

from rt_torchrl.compilation import compiled_if, marked_dynamic, plain
from rt_torchrl.engines.recurrence import march, march_by_scan
from rt_torchrl.interval import Drive, Interval

PIECE = 2048
"""Intervals that are linearised at once. Forward mode ties a compiled graph to one number; with pieces of this there is
one for all trajectories that are not shorter."""


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
        jacobians = over_all(partial(ctx.engine.linearise, ctx.interval), starts, drive)
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


def as_one_batch(starts: Tensor, drive: Drive) -> tuple[Tensor, Drive]:
    """The intervals of all realisations as rows, ``n·batch`` of them.

    What is asked of every interval at once does not care which trajectory it is of. One graph then serves every length
    and every number of realisations, and its loops are over one dimension: those over time and realisations, of which t
    has only the former, take the compiler of a drone's step a minute.
    """
    t = drive.t.expand(starts.shape[:2]).flatten()
    rows = Drive(t, drive.exogenous.flatten(0, 1), drive.command.flatten(0, 1))
    return marked_dynamic(starts.flatten(0, 1), 0), Drive(*(marked_dynamic(x, 0) for x in rows))


def over_all(function: Callable[[Tensor, Drive], Tensor], starts: Tensor, drive: Drive) -> Tensor:
    """``function`` of every interval, ``n batch ...``, in pieces of :data:`PIECE`, of which the last may overlap."""
    rows, driven = as_one_batch(starts, drive)
    length = min(PIECE, len(rows))
    firsts = [*range(0, len(rows) - length, length), len(rows) - length]
    found = [function(rows[k : k + length], Drive(*(x[k : k + length] for x in driven))) for k in firsts]
    found[-1] = found[-1][len(found) * length - len(rows) :]
    return torch.cat(found).unflatten(0, starts.shape[:2])


def _all_intervals(interval: Interval, starts: Tensor, drive: Drive) -> Tensor:
    """Φ at every interval at once."""
    return interval(starts, drive)


def linearise(interval: Interval, starts: Tensor, drive: Drive) -> Tensor:
    """∂Φ/∂s at every interval, ``... n_s n_s``, rows Φ and columns s, by n_s forward-mode products."""
    basis = torch.eye(starts.shape[-1], dtype=starts.dtype, device=starts.device)

    def column(direction: Tensor) -> Tensor:
        tangent = direction.expand_as(starts)
        return torch.func.jvp(lambda s: interval(s, drive), (starts,), (tangent,))[1]

    return torch.func.vmap(column, out_dims=-1)(basis)


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
