"""The check of a run: the gradient of its engine against that of plain autograd."""

import math

import torch
from torch import Tensor, nn

from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.rollout import Engine, Rollout
from rt_torchrl.trajectories.trajectory import control_cost

STEPS = 40
TOLERANCE = 1e-8
"""Greatest gap of an exact engine, whose rounding leaves some 1e-13."""
NEGLIGIBLE = 1e-4
"""Norm of a gradient, in units of the cost, below which its rounding is compared with this instead."""


def engine_gap(
    plant: Plant, closure: nn.Module, policy: nn.Module, unseen: UnseenEpisodes, engine: Engine = "native"
) -> float:
    """Relative gap ‖g − g_autograd‖/‖g_autograd‖ of the gradients of J_a by closure and policy weights.

    The plant is the physics of the twin, which flies two of the unseen episodes from what sensors read.

    Both engines run eagerly over a short horizon and two episodes, so that the check takes seconds.
    Weights that are not trained are left out.

    Args:
        plant: physics of the twin.
        closure: closure of the twin.
        policy: policy whose cost is differentiated.
        unseen: episodes of which two are flown.
        engine: engine to compare with ``autograd``.

    Returns:
        The gap; NaN if the gradient of autograd is not finite, of which no engine can be off. That of
        ``odeint_adjoint`` is of the order of its step, and no defect.

    Raises:
        ValueError: if the gap of an engine that should be exact is larger than rounding.
    """
    (gradient, _), (exact, cost) = (_gradient(plant, closure, policy, unseen, name) for name in (engine, "autograd"))
    if not exact.isfinite().all():
        return math.nan
    gap, scale = (gradient - exact).norm().item(), max(exact.norm().item(), NEGLIGIBLE * abs(cost))
    gap = math.inf if not math.isfinite(gap) else gap / scale if gap else 0.0
    if gap > TOLERANCE and engine != "odeint_adjoint":
        raise ValueError(
            f"engine={engine!r} gives another gradient of plant {plant.name!r} than 'autograd': over {STEPS} control "
            f"intervals they differ by {gap:.1e} of its norm, and at most {TOLERANCE:g} is rounding. Plant, closure "
            "and policy must be functions of their arguments and weights, without memory or random numbers of their "
            "own; check_plant(plant) says what of the plant is not. Nothing was trained."
        )
    return gap


def _gradient(
    plant: Plant, closure: nn.Module, policy: nn.Module, unseen: UnseenEpisodes, engine: Engine
) -> tuple[Tensor, float]:
    """The gradient, and the mean cost."""
    readings, exogenous = unseen.initial_state[:2, : len(unseen.plant.readings)], unseen.exogenous[:2, :STEPS]
    initial_state = plant.at_rest(readings)
    flown = Rollout(plant, closure, policy, engine=engine)(initial_state, exogenous)
    weights = [w for w in (*closure.parameters(), *policy.parameters()) if w.requires_grad]
    cost = control_cost(plant, flown).mean()
    if not cost.requires_grad:  # it depends on no weight
        return torch.zeros(sum(w.numel() for w in weights), dtype=cost.dtype, device=cost.device), cost.item()
    gradient = torch.autograd.grad(cost, weights, allow_unused=True, materialize_grads=True)
    return torch.cat([part.flatten() for part in gradient]), cost.item()
