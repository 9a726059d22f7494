"""Engine ``autograd``: plain backpropagation through the steps, the exact gradient of the discrete trajectory."""

from typing import ClassVar

from torch import Tensor, nn

from rt_torchrl.trajectories.engines.interval import Drive, GradientEngine
from rt_torchrl.trajectories.engines.parallel import compiled_if, march, march_by_scan, prepared


class Autograd(GradientEngine):
    """Records every operation of every step; memory and time grow with the number of steps.

    Args:
        compiled: run the recurrence and its reverse as one compiled scan.
    """

    own_scheme: ClassVar[bool] = True
    start_per_realisation: ClassVar[bool] = True

    def __init__(self, *, compiled: bool):
        self._march = compiled_if(compiled, march_by_scan, march)

    def end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable."""
        return self._march(interval, *prepared(initial_state, drive))
