"""The protocol of a start: what is known about a real system before the first episode of a training."""

from collections.abc import Callable, Mapping
from typing import Protocol, runtime_checkable

from torch import nn

from rt_torchrl.steps.config import Role
from rt_torchrl.twinning.config import Arm
from rt_torchrl.twinning.flight import Flight

Fly = Callable[[nn.Module], Flight]
"""Function that lets a policy or state feedback fly one episode on the real system, without exploration."""


@runtime_checkable
class Start(Protocol):
    """What a training begins with instead of random weights; the algorithm asks in the order of the methods."""

    @property
    def live(self) -> Role:
        """Role that acts in the first episode, where both policies are trained."""

    @property
    def teacher(self) -> nn.Module | None:
        """Policy or state feedback that policies imitate; None where only the flights show what it did."""

    def take(self, policies: Mapping[Role, nn.Module], closure: nn.Module) -> list[Role]:
        """Load the weights that are known into policies and closure, in place.

        Returns:
            The roles of the policies whose weights are not known: they imitate.
        """

    def flights(self, fly: Fly) -> list[Flight]:
        """Episodes of the real system, oldest first and of equal length, from which twin and policies learn.

        Args:
            fly: function that flies one on the real system; nothing is flown if enough is known without it.
        """


def first_live(arm: Arm, first: Start | None) -> Role:
    """The role that acts in the first episode: the only one that an arm trains or, of both, the one that begins."""
    if arm != "twinning":
        return arm
    return "model_free" if first is None else first.live
