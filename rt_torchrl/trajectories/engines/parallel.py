r"""Engine ``parallel``: the exact discrete adjoint, parallel over time.

With one interval as :math:`s_{k+1} = \Phi(s_k, x_k; w)`, the gradient of a cost :math:`J(s_0, \dots, s_n)` is

.. math::
    A_k = \frac{\partial\Phi}{\partial s}(s_k, x_k), \qquad
    \lambda_n = \frac{\partial J}{\partial s_n}, \quad
    \lambda_k = A_k^\top\lambda_{k+1} + \frac{\partial J}{\partial s_k}, \qquad
    \frac{dJ}{dw} = \sum_k \lambda_{k+1}^\top\frac{\partial\Phi}{\partial w}(s_k, x_k).

Only the recurrence of the states and the linear recurrence of λ are sequential. One batched call computes the Jacobians
of all intervals of all trajectories, and another one the sum over k; both are cut into pieces where intervals are many.
Both are backward passes of PyTorch, so that the engine takes whatever the engine ``autograd`` takes.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rt_torchrl.trajectories.engines.interval import Drive, GradientEngine, costate_products, march

PIECE, LARGE_PIECE = 2048, 2**17
"""Greatest numbers of intervals that are differentiated at once, which bound the memory: on a CPU, and on other
devices, where launching a kernel takes longer than its work on few rows."""


class Parallel(GradientEngine):
    """Computes the exact discrete adjoint in parallel over time; the module describes it."""

    def end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable."""
        weights = [w for w in interval.parameters() if w.requires_grad]
        return _DiscreteAdjoint.apply(interval, initial_state, *drive, *weights)


class _DiscreteAdjoint(torch.autograd.Function):
    """Maps (s_0, t, z, a, w) to s_1 ... s_n; the interval is passed along for its map."""

    @staticmethod
    def forward(
        ctx: Any,
        interval: nn.Module,
        initial_state: Tensor,
        t: Tensor,
        exogenous: Tensor,
        command: Tensor,
        *weights: Tensor,
    ) -> Tensor:
        ends = march(interval, initial_state, Drive(t, exogenous, command))
        ctx.interval = interval
        # Saving the weights lets autograd notice when one is changed between forward and backward.
        ctx.save_for_backward(initial_state, t, exogenous, command, ends, *weights)
        return ends

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cost_gradient: Tensor) -> tuple[Tensor | None, ...]:
        initial_state, t, exogenous, command, ends, *weights = ctx.saved_tensors
        starts, drive = torch.cat([initial_state.unsqueeze(0), ends[:-1]]), Drive(t, exogenous, command)
        jacobians = jacobians_by_rows(ctx.interval, starts, drive)
        after = costates(jacobians[1:], cost_gradient)  # λ_1 ... λ_n
        gradients = _products(ctx.interval, starts, drive, weights, after)
        return None, torch.einsum("bji,bj->bi", jacobians[0], after[0]), *gradients


def _products(
    interval: nn.Module, starts: Tensor, drive: Drive, weights: Sequence[Tensor], costates: Tensor
) -> list[Tensor]:
    """λᵀ∂Φ/∂x for t, z and a of every interval, and its sum over the intervals for every weight.

    The products are computed in pieces, because the tape of an interval holds every unit of a perceptron.
    """
    products = []
    for states, *driven, costate in _pieces(1, starts, drive, costates.flatten(0, 1)):
        driving = [x.clone().requires_grad_() for x in driven]
        leaves = *driving, *weights
        with torch.enable_grad():
            end = interval(states, Drive(*driving))
        products.append(costate_products(end, leaves, costate))
    t, exogenous, command, *of_weights = zip(*products, strict=True)
    # t may be the same for all realisations
    of_drive = [
        torch.cat(parts).unflatten(0, starts.shape[:2]).sum_to_size(x.shape)
        for parts, x in zip((t, exogenous, command), drive, strict=True)
    ]
    return of_drive + [sum(parts, torch.zeros_like(parts[0])) for parts in of_weights]


def costates(jacobians: Tensor, cost_gradient: Tensor) -> Tensor:
    """The co-states λ_1 ... λ_n from A_1 ... A_{n−1} and ∂J/∂s_1 ... ∂J/∂s_n, by a loop."""
    costate = cost_gradient[-1]
    reversed_costates = [costate]
    for transition, source in zip(jacobians.flip(0), cost_gradient[:-1].flip(0), strict=True):
        costate = torch.einsum("bji,bj->bi", transition, costate) + source
        reversed_costates.append(costate)
    return torch.stack(reversed_costates).flip(0)


# All intervals at once


def _pieces(each: int, starts: Tensor, drive: Drive, *others: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """States, drive and other rows of all intervals of all realisations in pieces; a row counts ``each`` times."""
    t = drive.t.expand(starts.shape[:2])
    rows = [x.flatten(0, 1) for x in (starts, t, drive.exogenous, drive.command)]
    size = max(1, (PIECE if starts.device.type == "cpu" else LARGE_PIECE) // each)
    yield from zip(*(x.split(size) for x in (*rows, *others)), strict=True)


def over_all(function: Callable[[Tensor, Drive], Tensor], starts: Tensor, drive: Drive) -> Tensor:
    """``function`` of every interval, ``n batch ...``, in pieces.

    Args:
        function: a function of states and drive of many intervals.
        starts: states at the starts of the intervals.
        drive: times and inputs of the intervals.
    """
    values = [function(states, Drive(*driving)) for states, *driving in _pieces(1, starts, drive)]
    return torch.cat(values).unflatten(0, starts.shape[:2])


def jacobians_by_rows(interval: nn.Module, starts: Tensor, drive: Drive) -> Tensor:
    """∂Φ/∂s at every interval, ``n batch n_s n_s``; an interval is computed once for each row of its Jacobian."""
    n_s, jacobians = starts.shape[-1], list[Tensor]()
    basis = torch.eye(n_s, dtype=starts.dtype, device=starts.device)
    for piece in _pieces(n_s, starts, drive):
        state, *driving = (x.repeat_interleave(n_s, 0) for x in piece)
        with torch.enable_grad():
            end = interval(state.requires_grad_(), Drive(*driving))
        jacobians += costate_products(end, (state,), basis.repeat(len(state) // n_s, 1))
    return torch.cat(jacobians).unflatten(0, (*starts.shape[:2], n_s))
