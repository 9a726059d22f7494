"""Reinforcement twinning of the flapping-wing drone (paper, sections 5.2 and 6.3)."""

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import nn

from rt_torchrl.algorithm import TwinningConfig
from rt_torchrl.assimilation import AssimilationConfig
from rt_torchrl.descent import DescentConfig
from rt_torchrl.envs.flapping_wing import figures
from rt_torchrl.envs.flapping_wing.animation import save_animation
from rt_torchrl.envs.flapping_wing.disturbances import GaussianGust
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.exogenous import ExogenousConfig
from rt_torchrl.model_based import ModelBasedConfig
from rt_torchrl.model_free import ModelFreeConfig
from rt_torchrl.policies import SaturatedMLP
from rt_torchrl.runner import Run, RunConfig, main_of
from rt_torchrl.switching import SwitchConfig

PAPER = TwinningConfig(
    # Table 1 of the paper, row T2; N_z, T_J and T_w are the library's defaults.
    model_free=ModelFreeConfig(critic_iterations=1000, actor_iterations=1000, discount=0.998),
    # The gust is smooth over its 3 s: what the default tube of the regression leaves would pass for drag.
    exogenous=ExogenousConfig(tube=2e-3, penalty=1e3),
    assimilation=AssimilationConfig(iterations=15, descent=DescentConfig(rate=0.1)),
    model_based=ModelBasedConfig(iterations=5, descent=DescentConfig(rate=0.2, gradient_limit=0.5)),
    switch=SwitchConfig(patience=4, clone_patience=4),
)


@dataclass(frozen=True, kw_only=True)
class Config(RunConfig):
    """Train twin and controllers on the flapping-wing drone.

    Args:
        policy: paper (affine in position and speed errors with offset, 10 weights) or mlp.
        hidden: widths of the hidden layers of an mlp policy.
        dt: control interval [s].
        horizon: length of an episode T_o [s].
        mean_wind: mean headwind [m/s].
        wind_deviation: standard deviation of the headwind [m/s].
        peak: height of the window of J_a around the target: unit, or the printed one.
    """

    policy: Literal["paper", "mlp"] = "paper"
    hidden: tuple[int, ...] = (32, 32)
    dt: float = 5e-4
    horizon: float = 5.0
    mean_wind: float = 1.0
    wind_deviation: float = 1.0
    peak: Literal["unit", "printed"] = "unit"
    unseen: int = 100
    twinning: TwinningConfig = field(default_factory=lambda: PAPER)

    def plant(self) -> FlappingWing:
        wind = GaussianGust(mean=self.mean_wind, std=self.wind_deviation)
        return FlappingWing(dt=self.dt, horizon=self.horizon, wind=wind, peak=self.peak)


def main(config: Config) -> None:
    plant = config.plant()

    def make_policy(generator: torch.Generator) -> nn.Module:
        if config.policy == "paper":
            return plant.make_policy(generator)
        return SaturatedMLP(len(plant.observations), plant.actions, hidden=config.hidden, generator=generator)

    Run(config, plant, make_policy=make_policy, plant_figures=figures.figures_of, animate=save_animation).train()


if __name__ == "__main__":
    main_of(Config, main)
