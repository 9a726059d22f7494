"""Planners for step 5."""

import torch
from torch import nn

from rt_torchrl.control.predictive_control import PredictiveControl
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.planners.constraints import Constraints
from rt_torchrl.twinning.planners.constraints_config import ConstraintsConfig
from rt_torchrl.twinning.planners.planner import Planner, PlannerConfig, ShortHorizonConfig
from rt_torchrl.twinning.planners.receding_horizon import RecedingHorizonPlanner
from rt_torchrl.twinning.planners.short_horizon import ShortHorizon
from rt_torchrl.twinning.planners.whole_episodes import WholeEpisodes


def make_planner(twin: DigitalTwin, policy: nn.Module, config: PlannerConfig, *, generator: torch.Generator) -> Planner:
    """The planner of a configuration; see :class:`PlannerConfig` for the methods.

    Args:
        twin: twin on which the policy is planned.
        policy: policy π_mb, updated in place.
        config: parameters of step 5.
        generator: source of the initial weights of a short horizon's critic.

    Raises:
        ValueError: if the method is receding_horizon and the policy is not :class:`PredictiveControl`, or the other way
            round.
    """
    if isinstance(policy, PredictiveControl):
        if config.method == "receding_horizon":
            return RecedingHorizonPlanner(twin, policy, config)
    elif config.method != "receding_horizon":
        if config.short_horizon.window:
            return ShortHorizon(twin, policy, config, generator=generator)
        return WholeEpisodes(twin, policy, config)
    raise ValueError(
        f"method={config.method!r} of the planning does not go with a policy of class {type(policy).__name__}: "
        "receding_horizon needs model_based=PredictiveControl(twin.plant, twin.closure, ...), and it alone."
    )


__all__ = [
    "Constraints",
    "ConstraintsConfig",
    "Planner",
    "PlannerConfig",
    "RecedingHorizonPlanner",
    "ShortHorizon",
    "ShortHorizonConfig",
    "WholeEpisodes",
    "make_planner",
]
