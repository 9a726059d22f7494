"""Planners for step 5."""

import torch
from torch import nn

from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.planners.planner import Planner, PlannerConfig, ShortHorizonConfig
from rt_torchrl.twinning.planners.short_horizon import ShortHorizon
from rt_torchrl.twinning.planners.whole_episodes import WholeEpisodes


def make_planner(twin: DigitalTwin, policy: nn.Module, config: PlannerConfig, *, generator: torch.Generator) -> Planner:
    """The planner of a configuration: over short windows if ``short_horizon.window`` is positive, else whole episodes.

    Args:
        twin: twin on which the policy is planned.
        policy: policy π_mb, updated in place.
        config: parameters of step 5.
        generator: source of the initial weights of a short horizon's critic.
    """
    if config.short_horizon.window:
        return ShortHorizon(twin, policy, config, generator=generator)
    return WholeEpisodes(twin, policy, config)


__all__ = ["Planner", "PlannerConfig", "ShortHorizon", "ShortHorizonConfig", "WholeEpisodes", "make_planner"]
