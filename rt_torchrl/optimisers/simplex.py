"""The simplex of Nelder and Mead, which searches a few weights without gradients."""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from rt_torchrl.interruption import safe_point
from rt_torchrl.optimisers.levenberg_marquardt import place

FEW = 20
"""Greatest number of weights that are searched."""


@torch.no_grad()
def by_simplex(module: nn.Module, cost: Callable[[], Tensor], count: int, *, size: float) -> float:
    """Search the trained weights of a module without gradients; it gets the best ones.

    Args:
        module: module with the weights.
        cost: function that returns the scalar cost at the module's present weights; it may raise
            ``FloatingPointError`` where the cost diverges.
        count: greatest number of costs.
        size: size of the first simplex, as a share of each weight.

    Returns:
        The lowest cost.
    """
    from scipy.optimize import minimize  # here, because the options of a recipe need not wait for it

    weights = [weight for weight in module.parameters() if weight.requires_grad]
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
    options = {"maxfev": count, "initial_simplex": simplex, "adaptive": True, "xatol": 1e-6, "fatol": 1e-12}
    return at(minimize(at, simplex[0], method="Nelder-Mead", options=options).x)
