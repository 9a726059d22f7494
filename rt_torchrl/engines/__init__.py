"""Three gradient engines for one trajectory: see :mod:`rt_torchrl.trajectory`."""

from rt_torchrl.engines.backpropagation import Backpropagation
from rt_torchrl.engines.continuous_adjoint import ContinuousAdjoint
from rt_torchrl.engines.parallel_adjoint import ParallelAdjoint

__all__ = ["Backpropagation", "ContinuousAdjoint", "ParallelAdjoint"]
