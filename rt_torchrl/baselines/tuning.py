"""Gains of a classical controller by a stated procedure: a simplex search for the least J_a on the real system."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize
from torch import Tensor

from rt_torchrl.baselines.classical import ClassicalController
from rt_torchrl.trajectories.trajectory import control_cost


@dataclass(frozen=True, kw_only=True)
class Tuned:
    """Mean J_a at the gains that the search started from and at those it found, and the evaluations it took."""

    start: float
    best: float
    evaluations: int


def tune(
    controller: ClassicalController,
    initial_state: Float[Tensor, "batch n_s"],
    exogenous: Float[Tensor, "batch n n_z"],
    *,
    evaluations: int = 80,
    spread: float = 2.0,
) -> Tuned:
    """Nelder and Mead's simplex over the logarithms of the gains, for the least mean J_a over the episodes given.

    Args:
        controller: starts from its present gains and is left with the best ones.
        initial_state: of the episodes that it is tuned on.
        exogenous: of the same.
        evaluations: flights of all episodes at most.
        spread: factor between the first simplex's corners, more than 1.

    Raises:
        ValueError: if the controller has no gains, or an argument is out of its range.
    """
    if not len(controller.log_gains):
        raise ValueError(f"controller {type(controller).__name__} has no gains to tune.")
    if evaluations < 1 or not spread > 1.0:
        raise ValueError(f"evaluations={evaluations} must be at least 1 and spread={spread} more than 1.")

    @torch.no_grad()
    def cost(log_gains: np.ndarray) -> float:
        controller.log_gains.copy_(torch.as_tensor(log_gains, device=controller.log_gains.device))
        value = control_cost(controller.plant, controller.fly(initial_state, exogenous)).mean().item()
        # A flight that leaves the finite numbers is worse than any other.
        return value if np.isfinite(value) else np.inf

    first = controller.log_gains.detach().cpu().numpy().copy()
    simplex = np.vstack([first, first + np.log(spread) * np.eye(len(first))])
    options = {"initial_simplex": simplex, "maxfev": evaluations, "xatol": 1e-2, "fatol": 1e-4}
    start = cost(first)
    found = minimize(cost, first, method="Nelder-Mead", options=options)
    with torch.no_grad():
        controller.log_gains.copy_(torch.as_tensor(found.x, device=controller.log_gains.device))
    return Tuned(start=start, best=float(found.fun), evaluations=int(found.nfev) + 1)
