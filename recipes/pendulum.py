"""Reinforcement twinning of Gymnasium's pendulum, a real system that is not this library's own."""

import dataclasses
from functools import partial
from typing import Any

import rt_torchrl as rt

rt.begin_loading(__name__)

from rt_torchrl.envs.pendulum.plant import Pendulum

SWING_UP = rt.TwinningConfig(
    records=1,
    # The model-free policy finds the swing-up and plans improve it, because descents from random weights end in another
    # minimum. White noise hardly moves the rod; this one fills the torque's range and lasts about a swing.
    exploration=rt.ExplorationConfig(spread=1.0, episodes=10, correlation_time=0.3),
    # Costs reach 16; the scale keeps values at the order of ten, which a perceptron can reach.
    learner=rt.LearnerConfig(critic_iterations=500, actor_iterations=1000, reward_scale=0.1, actor_rate=1e-3),
    # Ten seconds are about six swings, and their number depends on the length: a whole replay has a minimum for each.
    assimilation=rt.AssimilationConfig(segment=10),
    # Tiny changes decide whether a swing reaches the top: a plan on few episodes says little about others.
    planner=rt.PlannerConfig(iterations=10, realisations=64, descent=rt.DescentConfig()),
)


@rt.configuration
class Config(rt.RunConfig):
    """Train twin and controllers on Gymnasium's Pendulum-v1.

    Args:
        policy: plant (the plant's own perceptron of cos θ, sin θ and dθ/dt) or mlp.
        horizon: length of an episode T_o [s]; Gymnasium's is 10.
    """

    episodes: int = 10
    horizon: float = 10.0
    twinning: rt.TwinningConfig = SWING_UP

    def plant(self) -> Pendulum:
        return Pendulum(horizon=self.horizon)


def main(config: Config, **parts: Any) -> None:
    """Train; ``parts`` are further arguments of :class:`Run`, such as ``learner``."""
    # Here, because --help need not wait for TorchRL.
    from rt_torchrl.envs.pendulum.real import gymnasium_pendulum

    if not config.real_unseen:  # a simulator may fly
        config = dataclasses.replace(config, real_unseen=config.unseen)
    plant = config.plant()
    device = rt.require_device(config.device)
    env = partial(gymnasium_pendulum, plant, seed=config.seed, device=device)
    rt.Run(config, plant, env=env, **parts).train()


if __name__ == "__main__":
    rt.main_of(Config, main)
