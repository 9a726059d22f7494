"""What the learner sees of a system in operation, whichever clock it keeps."""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from tensordict import TensorDict
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.systems.operation.order import OrderBook
from rt_torchrl.systems.safety_report import SafetyReport


@runtime_checkable
class Operation(Protocol):
    """A real system in operation: windows come in, and policies are handed over, while the learner learns."""

    orders: OrderBook
    """The orders that later windows may have flown, or that the last one has."""
    report: SafetyReport | None
    """What the safety layer did in the window taken last; None if there is no layer."""
    acted: Mapping[str, float] | None
    """Numbers about what acted at the end of that window, if it has any."""

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

    def hand_over(
        self,
        name: str,
        policy: nn.Module,
        *,
        strength: float,
        found: dict[str, float | str] | None = None,
    ) -> None:
        """Hand a policy over, which takes over while the system operates.

        Args:
            name: name of the policy: its role, or ``first``.
            policy: the policy, as it is now.
            strength: strength ξ of the exploration.
            found: what was found about the policy before, by name.
        """

    def rollout(self) -> TensorDict:
        """The oldest window that has not been taken yet, of batch size ``1 n``; waits for it if necessary.

        Raises:
            EpisodeEndedError: if the system failed in that window, or ended it; it holds the intervals before.
        """

    def waiting(self) -> bool:
        """Whether a further window has come in already."""

    def close(self) -> None:
        """End the operation; the system gets its safe action from whatever stands behind it."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next window depends on, in tensors and plain containers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of an operation that was built with the same arguments."""


def system_of(env: EnvBase | Operation) -> EnvBase:
    """The real system itself, in operation or not."""
    return env.system if isinstance(env, Operation) else env
