"""What every gradient engine gives, and what it says of itself."""

from typing import ClassVar, Protocol

from torch import Tensor

from rt_torchrl.trajectories.engines.interval import Drive, Interval


class GradientEngine(Protocol):
    """Computes trajectories of a plant that can be differentiated; made with ``compiled=True`` or ``False``.

    Its name among the options is the name of its class, in small letters and with underscores.
    """

    own_scheme: ClassVar[bool]
    """Whether it takes plants that step by a scheme of their own, see :attr:`Plant.own_scheme`."""
    start_per_realisation: ClassVar[bool]
    """Whether every realisation can have a start time of its own."""

    def __init__(self, *, compiled: bool): ...

    def end_states(self, interval: Interval, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable by all that enters."""
        ...
