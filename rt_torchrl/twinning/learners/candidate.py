"""Weights that an update proposes, until a real episode has proved them."""

import copy
import math
from collections import deque
from statistics import median
from typing import Any

from torch import nn

from rt_torchrl.twinning.learners.weights import Weights, weights_of

COMPARED = 3
"""Number of episodes in a row, flown with weights that were kept, whose median cost an episode is compared with."""


class Candidate:
    """The weights that an update proposes: the policy flies with them, and keeps them unless that is dear.

    Without a twin nobody can judge an update before it flies. Between an update and the next flight the policy has the
    weights that are proved, so that these are what a training ends with.

    Args:
        policy: the policy.
        recovery: ratio of the cost of an episode to the least median cost of three in a row so far above which weights
            are not kept. Of the first episodes, which are fewer, it is the median of those.
    """

    def __init__(self, policy: nn.Module, recovery: float):
        self.policy, self.recovery = policy, recovery
        self._proposed: Weights | None = None
        self._proved: Weights | None = None
        self._costs: deque[float] = deque(maxlen=COMPARED)
        self._least = math.inf

    def nominate(self, proved: Weights) -> None:
        """Propose the policy's present weights, and give it back those that it flew with."""
        self._proposed, self._proved = weights_of(self.policy), proved
        self.policy.load_state_dict(proved)

    def board(self) -> None:
        """Give the policy the proposed weights, if there are any."""
        if self._proposed is not None:
            self.policy.load_state_dict(self._proposed)
            self._proposed = None

    def ground(self) -> None:
        """Give the policy its proved weights back where those on board have not flown; they are proposed again."""
        if self._proposed is None and self._proved is not None:
            self.nominate(self._proved)

    def flown(self, cost: float) -> bool:
        """Keep the weights with which the policy has flown, or give it back the earlier ones.

        Args:
            cost: J_a of the real episode.

        Returns:
            Whether the weights are kept.
        """
        usual = min(self._least, median(self._costs)) if self._costs else math.inf
        kept = self._proved is None or not cost > self.recovery * usual
        if kept:
            self._costs.append(cost)
            if len(self._costs) == COMPARED:
                self._least = min(self._least, median(self._costs))
        elif self._proved is not None:
            self.policy.load_state_dict(self._proved)
        self._proved = None
        return kept

    def state_dict(self) -> dict[str, Any]:
        weights = {"proposed": self._proposed, "proved": self._proved}
        return copy.deepcopy(weights) | {"costs": list(self._costs), "least": self._least}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._proposed, self._proved = state["proposed"], state["proved"]
        self._costs, self._least = deque(state["costs"], maxlen=COMPARED), state["least"]
