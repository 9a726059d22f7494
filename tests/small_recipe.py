"""A recipe of the oracle plant that takes seconds."""

from dataclasses import field

from linear_quadratic import LinearQuadratic
from small_runs import SMALL

from rt_torchrl import Run, RunConfig, TwinningConfig, configuration


@configuration
class Config(RunConfig):
    """Options of a training that takes a second.

    Args:
        horizon: length of an episode [s].
    """

    episodes: int = 1
    unseen: int = 3
    figures: bool = False
    horizon: float = 2.0
    twinning: TwinningConfig = field(default_factory=lambda: SMALL)

    def plant(self):
        return LinearQuadratic(horizon=self.horizon)


def main(config):
    Run(config, config.plant()).train()
