"""Three gradient engines for one trajectory: see :mod:`rt_torchrl.trajectories.rollout`."""

from rt_torchrl.trajectories.engines.backpropagation import Backpropagation
from rt_torchrl.trajectories.engines.continuous_adjoint import ContinuousAdjoint
from rt_torchrl.trajectories.engines.parallel_adjoint import ParallelAdjoint

__all__ = ["Backpropagation", "ContinuousAdjoint", "ParallelAdjoint"]
