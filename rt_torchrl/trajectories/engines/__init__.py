"""Four gradient engines for one trajectory: see :mod:`rt_torchrl.trajectories.rollout`."""

from rt_torchrl.trajectories.engines.interval import Autograd, GradientEngine, OdeintAdjoint
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.engines.parallel import Parallel

__all__ = ["Autograd", "GradientEngine", "Native", "OdeintAdjoint", "Parallel"]
