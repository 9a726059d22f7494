"""The check that a run makes before it trains: it compares the exact gradient with that of a second engine."""

import torch
from torch import Tensor, nn

from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.rollout import Engine, Rollout, refusal
from rt_torchrl.trajectories.trajectory import control_cost

STEPS = 40


def engine_gap(plant: Plant, closure: nn.Module, policy: nn.Module, unseen: UnseenEpisodes) -> float:
    """Relative gap ‖g − g_reference‖/‖g_reference‖ of the gradients of J_a by closure and policy weights.

    The plant is the physics of the twin, which flies two of the unseen episodes from what sensors read.

    The reference engine is ``odeint_adjoint``, the paper's adjoint, or ``autograd`` for a plant with a scheme of its
    own. Both run eagerly over a short horizon and two episodes, so that the check takes seconds.
    Weights that are not trained are left out.

    Raises:
        ValueError: if no weight of the closure or the policy is trained.
    """
    slow: Engine = "autograd" if refusal("odeint_adjoint", plant) else "odeint_adjoint"
    fast, reference = (_gradient(plant, closure, policy, unseen, engine) for engine in ("native", slow))
    return ((fast - reference).norm() / reference.norm()).item()


def _gradient(plant: Plant, closure: nn.Module, policy: nn.Module, unseen: UnseenEpisodes, engine: Engine) -> Tensor:
    read, exogenous = unseen.initial_state[:2, : len(unseen.plant.readings)], unseen.exogenous[:2, :STEPS]
    initial_state = plant.at_rest(read)
    flown = Rollout(plant, closure, policy, engine=engine)(initial_state, exogenous)
    weights = [w for w in (*closure.parameters(), *policy.parameters()) if w.requires_grad]
    if not weights:
        raise ValueError(
            f"closure {type(closure).__name__} and policy {type(policy).__name__} have no weight that is trained, so "
            "there is no gradient to check; set requires_grad of at least one."
        )
    gradient = torch.autograd.grad(control_cost(plant, flown).mean(), weights)
    return torch.cat([part.flatten() for part in gradient])
