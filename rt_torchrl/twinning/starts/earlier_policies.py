"""A start with the policies and the twin of an earlier training."""

from collections.abc import Mapping
from typing import Any

from torch import nn

from rt_torchrl.steps.config import Role
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.architecture import same_architecture
from rt_torchrl.twinning.flight import Flight
from rt_torchrl.twinning.hypotheses.ensemble import TwinEnsemble
from rt_torchrl.twinning.starts.start import Fly


class EarlierPolicies:
    """Policies and twin of an earlier training begin a new one; see :class:`Start` for the members.

    The weights of a policy of the same architecture are taken as they are: those of its own role, or else those of the
    policy that was live. Where a policy has another architecture, the live one flies one episode, and
    the other architecture imitates it.

    Args:
        policies: policies that were trained, by role; the live one is among them.
        closure: trained closure of the twin.
        live: role that was live at the end of that training, and begins live.
        hypotheses: closures and weights of the hypotheses, as :meth:`TwinEnsemble.load_hypotheses` takes them.
    """

    def __init__(
        self,
        policies: Mapping[Role, nn.Module],
        closure: nn.Module,
        live: Role,
        hypotheses: Mapping[str, Any] | None = None,
    ):
        self.policies, self.closure, self.live, self.hypotheses = policies, closure, live, hypotheses

    def hand_over(self, twin: DigitalTwin) -> None:
        """Give the new training's twin the hypotheses, if both have some, before the algorithm takes it.

        Raises:
            ValueError: if they are not those of the twin.
        """
        if self.hypotheses is not None and isinstance(twin, TwinEnsemble):
            twin.load_hypotheses(self.hypotheses)

    @property
    def teacher(self) -> nn.Module:
        """The policy that was live."""
        return self.policies[self.live]

    def take(self, policies: Mapping[Role, nn.Module], closure: nn.Module) -> list[Role]:
        """See :meth:`Start.take`.

        Raises:
            RuntimeError: if the closures are not of the same architecture.
        """
        closure.load_state_dict(self.closure.state_dict())
        pupils: list[Role] = []
        for role, policy in policies.items():
            own = self.policies.get(role, self.teacher)
            known = next((earlier for earlier in (own, self.teacher) if takes(policy, earlier)), None)
            if known is not None:
                policy.load_state_dict(known.state_dict())
            elif not isinstance(policy, StateFeedback):  # which plans on the closure and needs no weights
                pupils.append(role)
        return pupils

    def flights(self, fly: Fly) -> list[Flight]:
        return [fly(self.teacher)]


def takes(policy: nn.Module, earlier: nn.Module) -> bool:
    """Whether a policy takes the weights of an earlier one as they are."""
    if isinstance(policy, StateFeedback) or isinstance(earlier, StateFeedback):
        return type(policy) is type(earlier)
    return same_architecture(policy, earlier)
