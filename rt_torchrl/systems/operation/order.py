"""Orders from the learner to what acts: which policy takes over, with which weights."""

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Tensor, nn

from rt_torchrl.trajectories.state_feedback import StateFeedback

FIRST = "first"
"""Name of the policy or state feedback that acts before the trained policies do."""


class Order(NamedTuple):
    """A policy that is to take over at once.

    Attributes:
        version: number of the order, from 0; each interval of a record names the version that acted in it.
        name: name of the policy, such as its role.
        weights: its weights.
        strength: strength ξ of the exploration.
        found: what was found about the policy before, such as ``predicted_violations``, by name.
    """

    version: int
    name: str
    weights: dict[str, Tensor]
    strength: float
    found: dict[str, float | str] | None = None

    @classmethod
    def of(cls, version: int, name: str, policy: nn.Module, **given: Any) -> "Order":
        """The order of a policy as it is now; later changes of the policy do not reach it.

        Args:
            version: number of the order.
            name: name of the policy.
            policy: the policy.
            given: the other attributes.
        """
        weights = {key: value.detach().clone() for key, value in policy.state_dict().items()}
        return cls(version, name, weights, **given)

    def made(self, policies: dict[str, nn.Module]) -> nn.Module:
        """The policy with these weights, as a module of its own.

        Args:
            policies: a policy of each name, whose own weights stay as they are.
        """
        found = copy.deepcopy(policies[self.name])
        found.load_state_dict(self.weights)
        return found


def ready(order: Order, policies: dict[str, nn.Module]) -> nn.Module:
    """The policy of an order, ready to act: state feedback has made its first plan.

    Args:
        order: the order.
        policies: a policy of each name, whose own weights stay as they are.
    """
    found = order.made(policies)
    if isinstance(found, StateFeedback):
        found.begin()
    return found


class OrderBook(dict[int, Order]):
    """The latest orders by version: those of which later windows may still be, and those that have not acted yet."""

    def forget_before(self, version: int) -> None:
        """Forget all orders before a version."""
        for earlier in [known for known in self if known < version]:
            del self[earlier]

    def state_dict(self) -> list[dict[str, Any]]:
        return [order._asdict() for order in self.values()]

    def load_state_dict(self, state: Sequence[dict[str, Any]]) -> None:
        self.clear()
        self.update({order["version"]: Order(**order) for order in state})
