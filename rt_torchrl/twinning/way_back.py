"""Weights to plan from again where plans are stuck, because gradients explode."""

import copy
import math
from typing import Any

from tensordict import TensorDict
from torch import Tensor, nn

from rt_torchrl.optimisers.descent import stuck
from rt_torchrl.optimisers.norm import norm_of

Weights = dict[str, Tensor]


class WayBack:
    r"""The weights from which plans descended where gradients still said something.

    A plan may end where the closed loop is unstable for a while in most episodes. Their gradients are as long as small
    differences grow, and their directions say nothing, with a limit or without: every later plan ends where it begins.
    The next plan is then made from earlier weights, too: from those with which the last plan that was not stuck began,
    and from those of the first one.

    While plans stay stuck, such plans are made in the first episode, the second, the fourth, the eighth and so on.

    Args:
        limit: greatest share by which a gradient may say that the cost changes by itself, over the share by which the
            weights change; infinite for any.
    """

    def __init__(self, limit: float):
        self.limit = limit
        self._sound: list[Weights] = []
        self._episodes = 0

    def after(self, found: TensorDict, began: Weights, policy: nn.Module) -> list[Weights]:
        """The weights from which to plan again.

        Args:
            found: report of a plan.
            began: weights with which the plan began.
            policy: policy that the plan has updated.

        Returns:
            Earlier weights, or none if the plan is not stuck or another one of its kind has been made of late.
        """
        if math.isinf(self.limit):
            return []
        if not self._stuck(found, [began[name] for name, w in policy.named_parameters() if w.requires_grad]):
            self._sound, self._episodes = [*self._sound[:1], began], 0
            return []
        self._episodes += 1
        return list(reversed(self._sound)) if self._episodes.bit_count() == 1 else []

    def _stuck(self, found: TensorDict, began: list[Tensor]) -> bool:
        """Whether a plan gained nothing, although its first gradient is longer than the limit or no number."""
        if "policy_gradient" not in found:
            return True
        before, after, gradient = (found[key].item() for key in ("J_a_plan_before", "J_a_plan", "policy_gradient"))
        return stuck(before, after, gradient * norm_of(began).item(), self.limit)

    def state_dict(self) -> dict[str, Any]:
        """The weights, and for how many episodes plans have been stuck."""
        return {"sound": copy.deepcopy(self._sound), "episodes": self._episodes}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of another one."""
        self._sound, self._episodes = list(state["sound"]), state["episodes"]
