"""Tuning of a classical controller: a simplex search for the gains of least J_a on the real system."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import control_cost


@dataclass(frozen=True, kw_only=True)
class Tuned:
    """Mean J_a at the first gains and at the gains that the search found, and the number of its evaluations."""

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
    plant: Plant | None = None,
) -> Tuned:
    """Minimise the mean J_a of the episodes over the logarithms of the gains by Nelder and Mead's simplex.

    Args:
        controller: the controller; the search starts from its present gains and leaves the best ones in it.
        initial_state: initial states of the episodes.
        exogenous: exogenous inputs of the episodes.
        evaluations: greatest number of evaluations; each flies all episodes.
        spread: factor on one gain between corners of the first simplex, more than 1.
        plant: physics of the system that is flown; None for the controller's own plant.

    Raises:
        ValueError: if the controller has no gains, or an argument is out of its range.
    """
    from scipy.optimize import minimize  # here, because it takes a second to load and --help need not wait for it

    if not len(controller.log_gains):
        raise ValueError(f"controller {type(controller).__name__} has no gains to tune.")
    if evaluations < 1 or not spread > 1.0:
        raise ValueError(f"evaluations={evaluations} must be at least 1 and spread={spread} more than 1.")

    system = controller.plant if plant is None else plant

    @torch.no_grad()
    def cost(log_gains: np.ndarray) -> float:
        controller.log_gains.copy_(torch.as_tensor(log_gains, device=controller.log_gains.device))
        try:
            value = control_cost(system, controller.fly(initial_state, exogenous, plant=system)).mean().item()
        except DivergenceError:
            return np.inf  # a flight that leaves the finite numbers is worse than any other
        return value if np.isfinite(value) else np.inf

    first = controller.log_gains.detach().cpu().numpy().copy()
    simplex = np.vstack([first, first + np.log(spread) * np.eye(len(first))])
    options = {"initial_simplex": simplex, "maxfev": evaluations, "xatol": 1e-2, "fatol": 1e-4}
    start = cost(first)
    found = minimize(cost, first, method="Nelder-Mead", options=options)
    with torch.no_grad():
        controller.log_gains.copy_(torch.as_tensor(found.x, device=controller.log_gains.device))
    return Tuned(start=start, best=float(found.fun), evaluations=int(found.nfev) + 1)
