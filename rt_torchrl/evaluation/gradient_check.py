"""The check a run makes before it trains: the exact gradient against a second engine, the paper's adjoint."""

import torch
from torch import Tensor, nn

from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.trajectories.rollout import Engine, Rollout
from rt_torchrl.trajectories.trajectory import control_cost

STEPS = 40


def engine_gap(closure: nn.Module, policy: nn.Module, unseen: UnseenEpisodes) -> float:
    """Relative gap ‖g_parallel − g_reference‖/‖g_reference‖ of dJ_a over closure and policy weights.

    The reference is ``odeint_adjoint``, or ``autograd`` for a plant with a scheme of its own. Over a short horizon and
    two episodes, eager, so that it costs seconds and not minutes.
    """
    slow: Engine = "autograd" if unseen.plant.own_scheme else "odeint_adjoint"
    fast, reference = (_gradient(closure, policy, unseen, engine) for engine in ("parallel", slow))
    return ((fast - reference).norm() / reference.norm()).item()


def _gradient(closure: nn.Module, policy: nn.Module, unseen: UnseenEpisodes, engine: Engine) -> Tensor:
    initial_state, exogenous = unseen.initial_state[:2], unseen.exogenous[:2, :STEPS]
    flown = Rollout(unseen.plant, closure, policy, engine=engine)(initial_state, exogenous)
    weights = [*closure.parameters(), *policy.parameters()]
    gradient = torch.autograd.grad(control_cost(unseen.plant, flown).mean(), weights)
    return torch.cat([part.flatten() for part in gradient])
