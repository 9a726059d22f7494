"""A start with a controller that the real system has had so far, or with model predictive control on the twin."""

from collections.abc import Mapping

from torch import nn

from rt_torchrl.steps.config import Role
from rt_torchrl.twinning.flight import Flight
from rt_torchrl.twinning.starts.start import Fly


class FirstController:
    """A controller flies one episode before all others, and policies imitate it; see :class:`Start` for the members.

    Args:
        controller: the controller, as :class:`StateFeedback`, such as a :class:`ClassicalController`,
            or :class:`PredictiveControl` on the closure of the twin.
    """

    live: Role = "model_based"

    def __init__(self, controller: nn.Module):
        self.teacher = controller

    def take(self, policies: Mapping[Role, nn.Module], closure: nn.Module) -> list[Role]:
        return list(policies)

    def flights(self, fly: Fly) -> list[Flight]:
        return [fly(self.teacher)]
