"""Earlier weights to plan from again: the first ones, and sound ones where gradients explode."""

import math
from typing import Any

from tensordict import TensorDict
from torch import Tensor, nn

from rt_torchrl.optimisers.descent import stuck

Weights = dict[str, Tensor]


class WayBack:
    r"""The weights with which earlier plans began, and from which the next plan is made, too.

    *From the first ones.* The first plan knows the inputs of one episode or two, and may lie in a minimum that is poor
    under those of others.

    *From sound ones.* A plan may end where the closed loop is unstable for a while in most episodes. Their gradients
    are as long as small differences grow, and their directions say nothing, with a limit or without: every later plan
    ends where it begins. A plan that gains nothing or is refused beside such a gradient is stuck. It is made again from
    the weights with which the last plan began that was not, and from the first ones: in the first episode whose plan is
    stuck, and in the second, the fourth, the eighth and so on while they stay so.

    Args:
        limit: greatest share by which a gradient may say that the cost changes by itself, over the share by which the
            weights change; infinite for any.
        anew: number of plans, of which all but the first are also made from the weights of the first.
    """

    def __init__(self, limit: float, anew: int = 0):
        self.limit, self.anew = limit, anew
        self._sound: list[Weights] = []
        self._plans = self._stuck = 0

    def after(self, found: TensorDict, began: Weights, policy: nn.Module) -> list[Weights]:
        """The weights from which to plan again.

        Args:
            found: report of a plan.
            began: weights with which the plan began.
            policy: policy that the plan has updated.

        Returns:
            Earlier weights; none for a plan that is not stuck, unless it is one of the first, and none for one that is
            where they have been tried of late.
        """
        self._plans += 1
        first = self._sound[:1]
        if self._is_stuck(found, [began[name] for name, w in policy.named_parameters() if w.requires_grad]):
            self._stuck += 1
            return self._sound[::-1] if self._stuck.bit_count() == 1 else []
        self._sound, self._stuck = [*first, began], 0
        return first if self._plans <= self.anew else []

    def _is_stuck(self, found: TensorDict, began: list[Tensor]) -> bool:
        """Whether a plan gained nothing or was refused, and its gradient is longer than the limit or no number."""
        if math.isinf(self.limit):
            return False
        if "policy_gradient" not in found:
            return True
        before, after, gradient = (found[key].item() for key in ("J_a_plan_before", "J_a_plan", "policy_gradient"))
        return stuck(before, after, gradient, began, self.limit)

    def state_dict(self) -> dict[str, Any]:
        """The weights, the number of plans, and for how many of the last ones these have been stuck."""
        return {"sound": list(self._sound), "plans": self._plans, "stuck": self._stuck}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of another one."""
        self._sound, self._plans, self._stuck = list(state["sound"]), state["plans"], state["stuck"]
