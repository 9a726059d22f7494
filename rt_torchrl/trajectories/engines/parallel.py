r"""Engine ``parallel``: the exact discrete adjoint, parallel over time.

With one interval as :math:`s_{k+1} = \Phi(s_k, x_k; w)`, the gradient of a cost :math:`J(s_0, \dots, s_n)` is

.. math::
    A_k = \frac{\partial\Phi}{\partial s}(s_k, x_k), \qquad
    \lambda_n = \frac{\partial J}{\partial s_n}, \quad
    \lambda_k = A_k^\top\lambda_{k+1} + \frac{\partial J}{\partial s_k}, \qquad
    \frac{dJ}{dw} = \sum_k \lambda_{k+1}^\top\frac{\partial\Phi}{\partial w}(s_k, x_k).

Only the recurrence of the states and the linear recurrence of λ are sequential. One batched call computes the Jacobians
of all intervals of all trajectories, and another one the sum over k; both are cut into pieces where intervals are many.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rt_torchrl.trajectories.engines.compilation import compiled_if, marked_dynamic, plain
from rt_torchrl.trajectories.engines.gradient_engine import GradientEngine
from rt_torchrl.trajectories.engines.interval import Drive
from rt_torchrl.trajectories.engines.linearisation import as_one_batch, linearise, over_all, piece, pieces, prepared
from rt_torchrl.trajectories.engines.recurrence import march, march_by_scan


class Parallel(GradientEngine):
    """Computes the exact discrete adjoint in parallel over time; the module describes it.

    Args:
        compiled: compile the two recurrences, the Jacobians and the final product.
    """

    own_scheme: ClassVar[bool] = True
    start_per_realisation: ClassVar[bool] = True

    def __init__(self, *, compiled: bool):
        self.march = compiled_if(compiled, march_by_scan, march)
        self.linearise = compiled_if(compiled, linearise)
        self.costates = compiled_if(compiled, costates_by_scan, costates)
        self.intervals = compiled_if(compiled, _all_intervals)

    def end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable."""
        initial_state, drive = prepared(initial_state, drive)
        weights = [w for w in interval.parameters() if w.requires_grad]
        return _DiscreteAdjoint.apply(self, interval, initial_state, *drive, *weights)


class _DiscreteAdjoint(torch.autograd.Function):
    """Maps (s_0, t, z, a, w) to s_1 ... s_n; the engine and the interval are passed along for their maps."""

    @staticmethod
    def forward(
        ctx: Any,
        engine: Parallel,
        interval: nn.Module,
        initial_state: Tensor,
        t: Tensor,
        exogenous: Tensor,
        command: Tensor,
        *weights: Tensor,
    ) -> Tensor:
        ends = engine.march(interval, initial_state, Drive(t, exogenous, command))
        ctx.engine, ctx.interval = engine, interval
        # Saving the weights lets autograd notice when one is changed between forward and backward.
        ctx.save_for_backward(initial_state, t, exogenous, command, ends, *weights)
        return ends

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cost_gradient: Tensor) -> tuple[Tensor | None, ...]:
        initial_state, t, exogenous, command, ends, *weights = ctx.saved_tensors
        starts, drive = torch.cat([initial_state.unsqueeze(0), ends[:-1]]), Drive(t, exogenous, command)
        jacobians = over_all(partial(ctx.engine.linearise, ctx.interval, ()), starts, drive)
        sources = marked_dynamic(plain(cost_gradient), 1)
        costates = ctx.engine.costates(marked_dynamic(jacobians[1:], 1), sources)  # λ_1 ... λ_n
        wanted = ctx.needs_input_grad[3:]  # t, exogenous, command and the weights
        found = _products(ctx.engine.intervals, ctx.interval, starts, drive, weights, costates, wanted)
        first = torch.einsum("bji,bj->bi", jacobians[0], costates[0]) if ctx.needs_input_grad[2] else None
        return None, None, first, *found


def _products(
    function: Callable[[nn.Module, Tensor, Drive], Tensor],
    interval: nn.Module,
    starts: Tensor,
    drive: Drive,
    weights: Sequence[Tensor],
    costates: Tensor,
    wanted: Sequence[bool],
) -> list[Tensor | None]:
    """λᵀ∂Φ/∂x for t, z and a of every interval, and its sum over the intervals for every weight; None if not wanted.

    The products are computed in pieces, because the tape of an interval holds every unit of a perceptron.
    """
    if not any(wanted):
        return [None] * len(wanted)
    rows, driven = as_one_batch(starts, drive)
    found = []
    for at in pieces(len(rows)):
        states, driving = piece(rows, driven, at.start, at.stop)
        inputs = [*driving, *weights]
        with torch.enable_grad():
            for x, need in zip(driving, wanted, strict=False):
                marked_dynamic(x, 0).requires_grad_(need)
            out = function(interval, marked_dynamic(states, 0), driving)
        leaves = [x for x, need in zip(inputs, wanted, strict=True) if need]
        found.append(torch.autograd.grad(out, leaves, costates.flatten(0, 1)[at], allow_unused=True))
    gathered = iter(zip(*found, strict=True))
    shape = starts.shape[:2]
    of_drive = [_of_rows(next(gathered), shape, x) if need else None for x, need in zip(drive, wanted, strict=False)]
    return of_drive + [_summed(next(gathered)) if need else None for need in wanted[len(drive) :]]


def _of_rows(parts: Sequence[Tensor | None], shape: torch.Size, drive: Tensor) -> Tensor | None:
    """The gradients of all rows in the shape of the drive, where t may be the same for all realisations."""
    found = _known(parts)
    return torch.cat(found).unflatten(0, shape).sum_to_size(drive.shape) if found else None


def _summed(parts: Sequence[Tensor | None]) -> Tensor | None:
    found = _known(parts)
    return reduce(torch.add, found) if found else None


def _known(parts: Sequence[Tensor | None]) -> list[Tensor]:
    """Gradients of the pieces: all of them, or none for an input that the intervals do not depend on."""
    return [part for part in parts if part is not None]


def _all_intervals(interval: nn.Module, starts: Tensor, drive: Drive) -> Tensor:
    """Φ at every interval at once."""
    ends: Tensor = interval(starts, drive)
    return ends


def costates(jacobians: Tensor, cost_gradient: Tensor) -> Tensor:
    """The co-states λ_1 ... λ_n from A_1 ... A_{n−1} and ∂J/∂s_1 ... ∂J/∂s_n, by a loop."""
    costate = cost_gradient[-1]
    reversed_costates = [costate]
    for transition, source in zip(jacobians.flip(0), cost_gradient[:-1].flip(0), strict=True):
        costate = torch.einsum("bji,bj->bi", transition, costate) + source
        reversed_costates.append(costate)
    return torch.stack(reversed_costates).flip(0)


def costates_by_scan(jacobians: Tensor, cost_gradient: Tensor) -> Tensor:
    """The co-states of :func:`costates` by one ``scan``, for the compiler."""
    from hoptorch.scan import scan  # here, because it takes seconds to load and only the compiler needs it

    def body(costate: Tensor, x: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        transition, source = x
        costate = ((transition * costate.unsqueeze(-1)).sum(-2) + source).contiguous()
        return costate, costate.clone()

    last = plain(cost_gradient[-1])
    earlier = scan(body, last, (jacobians.flip(0), cost_gradient[:-1].flip(0)))[1]
    return torch.cat([earlier.flip(0), last.unsqueeze(0)])
