"""Four gradient engines for one trajectory: see :mod:`rt_torchrl.trajectories.rollout`."""

from rt_torchrl.trajectories.engines.autograd import Autograd
from rt_torchrl.trajectories.engines.interval import GradientEngine
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.engines.odeint_adjoint import OdeintAdjoint
from rt_torchrl.trajectories.engines.parallel import Parallel

__all__ = ["Autograd", "GradientEngine", "Native", "OdeintAdjoint", "Parallel"]
