"""The mean cost of several episodes, in whose gradient no episode counts for far more than the others."""

import math
from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.optimisers.norm import norm_of


def limited_mean(costs: Float[Tensor, " episodes"], weights: Iterable[Tensor], limit: float) -> Float[Tensor, ""]:
    r"""The mean of costs, with a limit for the gradient of each.

    With :math:`g_i = \partial J_i/\partial w` the gradient is

    .. math:: \frac1N\sum_i g_i\min\Bigl(1, \frac{\kappa\,|J_i|}{\|w\|\,\|g_i\|}\Bigr)

    where κ is the limit: a gradient is too long if it says that the cost changes by itself when the weights change by
    less than a share 1/κ of their norm. Where a closed loop is unstable for a while, small differences grow
    exponentially, and so do gradients, although the cost hardly changes. Such an episode would decide on the direction
    of a descent alone.

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
    allowed = limit * costs.detach().abs() / norm_of([weight.detach() for weight in weights])
    # A cost of zero says nothing about what is long.
    shares = torch.where((norms > allowed) & (allowed > 0.0), allowed / norms, 1.0)
    found = costs.detach().mean()
    for weight, part in zip(weights, slopes, strict=True):
        slope = torch.tensordot(shares, part, 1) / len(costs)
        found = found + ((weight - weight.detach()) * slope).sum()
    return found
