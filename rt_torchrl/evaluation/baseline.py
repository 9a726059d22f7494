"""What policies are compared with."""

from abc import ABC, abstractmethod

from torch import nn

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Trajectory


class RealController(nn.Module, ABC):
    """A controller that can only be flown on the real system.

    Args:
        plant: physics and control problem of the twin.
        compiled: compile what can be.
    """

    def __init__(self, plant: Plant, *, compiled: bool = False):
        super().__init__()
        self.plant = plant

    @abstractmethod
    def fly_real(self, count: int, *, seed: int) -> Trajectory:
        """As many episodes of the sequence that belongs to a seed."""


Baseline = ClassicalController | RealController
"""A controller that is judged beside the policies: on the plant, or on a real system of which no closure is known."""
