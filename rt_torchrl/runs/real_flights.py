"""The flights on a real system after a training: none unasked, none of random weights, and each of them paid."""

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import nn

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.evaluation.real_episodes import RealEpisodes
from rt_torchrl.evaluation.unseen import Baseline, Judged, RealController, mean_with_confidence
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.steps.config import Role
from rt_torchrl.steps.imitation import clones
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory


class Contender(NamedTuple):
    """A controller that is to fly the real system, and what it is called before it does."""

    called: str
    fly: Callable[[], Trajectory]


class RealFlights(NamedTuple):
    """What a controller has flown on the real system after the training, and what that cost."""

    flown: Trajectory
    judged: Judged


def contenders(
    config: RunConfig,
    system: RealSystem,
    algorithm: ReinforcementTwinning,
    untrained: Mapping[Role, nn.Module],
    first: type[ClassicalController] | None,
    baselines: Mapping[str, Baseline],
    *,
    device: torch.device,
) -> dict[str, Contender]:
    """The controllers that are to fly the real system after the training, by name.

    These are the live policy, unless it still has the random weights that it began with; the controller that the
    training has begun with; and the controllers that nothing but the real system can fly.

    Args:
        config: options of the run.
        system: the real system.
        algorithm: the training at its end.
        untrained: the policies before it.
        first: class of the controller that the real system has had so far.
        baselines: controllers that are judged beside the policies.
        device: device of the twin.
    """
    found: dict[str, Contender] = {}
    if not config.real_unseen:
        return found
    asked = RealEpisodes(system, config.real_unseen, device=device)
    live = algorithm.referee.live
    policy = algorithm.policies[live]
    known = config.start != "random" or isinstance(policy, StateFeedback)
    if known or not clones(policy, untrained[live]):
        found[live] = Contender(f"the live policy ({live.replace('_', '-')})", partial(asked.fly, policy))
    if config.start == "controller" and first is not None:
        controller = first(algorithm.twin.plant).to(device)
        name = first.__name__ if first.__name__ not in baselines else f"{first.__name__} (first)"
        found[name] = Contender(name, partial(asked.fly, controller))
    for name, law in baselines.items():
        if isinstance(law, RealController):
            found[name] = Contender(name, partial(asked.fly_baseline, law))
    return found


def announcement(found: Mapping[str, Contender], count: int) -> str:
    """How many flights of whom there will be on the real system, where each controller makes so many."""
    each = ", ".join(f"{count} of {one.called}" for one in found.values())
    return f"{count * len(found)} flights on the real system: {each}; they count as paid"


def entries(flights: Mapping[str, RealFlights], J_p: Mapping[str, torch.Tensor]) -> dict[str, Any]:
    """The entry ``real_unseen`` of the summary.

    Args:
        flights: flights by the name of the controller.
        J_p: costs of the twin on the flights of the live policy, by name; empty without such flights.
    """
    return {
        "controllers": {
            name: {"episodes": len(one.judged.control_costs)} | one.judged.statistics() for name, one in flights.items()
        },
        "costs": {name: one.judged.control_costs.tolist() for name, one in flights.items()},
    } | {name: mean_with_confidence(costs) for name, costs in J_p.items()}


def paid_before(folder: Path) -> list[float | None]:
    """J_a of the flights that earlier ends of a resumed run have made; null stands for one that is not finite."""
    try:
        found = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        return []
    before: list[float | None] = found["summary"]["cost_of_learning"].get("judging", [])
    return before


def paid(flights: Mapping[str, RealFlights]) -> list[float]:
    """J_a of every flight."""
    return [cost for one in flights.values() for cost in one.judged.control_costs.tolist()]
