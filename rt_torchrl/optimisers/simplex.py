"""The simplex of Nelder and Mead, which searches few weights without gradients."""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from rt_torchrl.interruption import safe_point
from rt_torchrl.optimisers.levenberg_marquardt import place

FEW = 40
"""Greatest number of weights that are searched."""


def searched(module: nn.Module) -> list[nn.Parameter]:
    """The trained weights of a module; of one with more than ``FEW``, the last ones, such as an output layer's."""
    weights = list[nn.Parameter]()
    for weight in reversed([weight for weight in module.parameters() if weight.requires_grad]):
        if sum(part.numel() for part in (weight, *weights)) > FEW:
            break
        weights.insert(0, weight)
    return weights


@torch.no_grad()
def by_simplex(weights: list[nn.Parameter], cost: Callable[[], Tensor], count: int, *, size: float) -> float:
    """Search weights without gradients; they get the best values.

    Args:
        weights: the weights, such as those of :func:`searched`.
        cost: function that returns the scalar cost at the present weights; it may raise ``FloatingPointError`` where
            the cost diverges.
        count: greatest number of costs for each weight.
        size: size of the first simplex, as a share of each weight.

    Returns:
        The lowest cost.
    """
    from scipy.optimize import minimize  # here, because the options of a recipe need not wait for it

    start = parameters_to_vector(weights)
    scale = size * start.abs().clamp_min(0.1)

    def at(shares: np.ndarray) -> float:
        safe_point()
        place(start + scale * torch.as_tensor(shares, device=start.device), weights)
        try:
            value = cost().item()
        except FloatingPointError:
            return math.inf
        return value if math.isfinite(value) else math.inf

    simplex = np.concatenate([np.zeros((1, len(start))), np.eye(len(start))])
    options = {
        "maxfev": count * len(start),
        "initial_simplex": simplex,
        "adaptive": len(start) > 1,  # which shrinks a simplex of one weight to a point
        "xatol": 1e-6,
        "fatol": 1e-12,
    }
    return at(minimize(at, simplex[0], method="Nelder-Mead", options=options).x)
