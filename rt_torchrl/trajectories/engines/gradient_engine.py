"""The protocol of gradient engines: what they compute, and which plants and starts they support."""

from typing import ClassVar, Protocol

from torch import Tensor

from rt_torchrl.trajectories.engines.interval import Drive, Interval


class GradientEngine(Protocol):
    """Computes differentiable trajectories of a plant, compiled or eager.

    The options name an engine by its class, in small letters and with underscores.
    """

    own_scheme: ClassVar[bool]
    """Whether the engine takes plants that step by a scheme of their own, see :attr:`Plant.own_scheme`."""
    start_per_realisation: ClassVar[bool]
    """Whether every realisation can have a start time of its own."""

    def __init__(self, *, compiled: bool): ...

    def end_states(self, interval: Interval, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable by weights, initial state and drive."""
        ...

    def costs(self, interval: Interval, initial_state: Tensor, drive: Drive) -> Tensor | None:
        """Means of the running cost over all intervals, ``batch``, differentiable; None if they follow from the states.

        An engine computes them itself if this is quicker than to differentiate the costs of all states.
        """
        return None
