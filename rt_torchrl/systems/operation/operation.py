"""What the learner sees of a system in operation, whichever clock it keeps."""

from typing import Any, Protocol, runtime_checkable

from tensordict import TensorDict
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.systems.operation.order import OrderBook


@runtime_checkable
class Operation(Protocol):
    """A real system in operation: windows come in, and policies are handed over, while the learner learns."""

    orders: OrderBook
    """The orders that later windows may have flown, or that the last one has."""

    @property
    def system(self) -> EnvBase:
        """The real system as the learner knows it."""

    @property
    def closure(self) -> nn.Module | None:
        """The true closure of the system, as far as it is known."""

    @property
    def begun(self) -> bool:
        """Whether a policy has been handed over yet."""

    @property
    def version(self) -> int:
        """Number of the latest order; -1 before the first."""

    def hand_over(self, name: str, policy: nn.Module, *, strength: float, episode: int) -> None:
        """Hand a policy over, which takes over while the system operates.

        Args:
            name: name of the policy: its role, or ``first``.
            policy: the policy, as it is now.
            strength: strength ξ of the exploration.
            episode: number of the learner's episode.
        """

    def rollout(self) -> TensorDict:
        """The oldest window that has not been taken yet, of batch size ``1 n``; waits for it if necessary."""

    def waiting(self) -> bool:
        """Whether a further window has come in already."""

    def close(self) -> None:
        """End the operation; the system gets its safe action from whatever stands behind it."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next window depends on, in tensors and plain containers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of an operation that was built with the same arguments."""


def segments_of(window: TensorDict, first: int) -> list[tuple[int, int]]:
    """The versions that acted in a window, each with the interval in which it began to.

    Args:
        window: window of batch size ``1 n``.
        first: number of its first interval since the operation began.
    """
    versions = window["version"].flatten().tolist()
    starts = [k for k in range(len(versions)) if k == 0 or versions[k] != versions[k - 1]]
    return [(first + k, versions[k]) for k in starts]
