"""The mean cost of several episodes, in whose gradient no episode counts for far more than the others."""

import math
from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

TYPICAL = 0.75
"""Quantile of the norms of the episodes' gradients that is taken as typical; a policy at its bounds has many zeros."""


def limited_mean(costs: Float[Tensor, " episodes"], weights: Iterable[Tensor], limit: float) -> Float[Tensor, ""]:
    r"""The mean of costs, with a limit for the gradient of each.

    With :math:`g_i = \partial J_i/\partial w` the gradient is

    .. math:: \frac1N\sum_i g_i\min\Bigl(1, \frac{\kappa\,g_{3/4}\max(1, |J_i|/J_{1/2})}{\|g_i\|}\Bigr)^2

    where κ is the limit, :math:`g_{3/4}` the upper quartile of the norms and :math:`J_{1/2}` the median of :math:`|J|`:
    an episode that costs more may have a longer gradient, and one far beyond the limit counts for nothing. Where a
    closed loop is unstable for a while, small differences grow exponentially, and so do gradients, although the cost
    hardly changes. Such an episode would decide on the direction of a descent alone.

    Args:
        costs: costs J of the episodes, which depend on each weight.
        weights: weights w by which the mean is differentiated.
        limit: limit κ; infinite for the mean as it is.

    Returns:
        The mean, differentiable once by the weights and by nothing else if there is a limit.
    """
    if math.isinf(limit) or not costs.requires_grad:
        return costs.mean()
    weights = [w for w in weights if w.requires_grad]
    each = [torch.autograd.grad(cost, weights, retain_graph=True, materialize_grads=True) for cost in costs]
    slopes = [torch.stack(parts) for parts in zip(*each, strict=True)]
    norms = torch.stack([part.reshape(len(costs), -1).norm(dim=1) for part in slopes]).norm(dim=0)
    shares = _shares(costs.detach(), norms, limit)
    found = costs.detach().mean()
    for weight, part in zip(weights, slopes, strict=True):
        slope = torch.tensordot(shares, part, 1) / len(costs)
        found = found + ((weight - weight.detach()) * slope).sum()
    return found


def _shares(costs: Tensor, norms: Tensor, limit: float) -> Tensor:
    """The share of each episode's gradient that counts."""
    typical, middle = norms.quantile(TYPICAL), costs.abs().median()
    if typical == 0.0:  # most episodes are at the bounds, and say nothing of what is usual
        return torch.ones_like(norms)
    dearer = (costs.abs() / middle.clamp_min(torch.finfo(costs.dtype).tiny)).clamp_min(1.0)
    allowed = limit * typical * dearer
    return torch.where(norms > allowed, (allowed / norms).square(), 1.0)
