"""Step 2: the learner's update, which step 6 can take back where it is worse."""

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn

from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.twinning.evidence.alarm import MATTERS
from rt_torchrl.twinning.evidence.real_judge import RealJudge
from rt_torchrl.twinning.findings import findings
from rt_torchrl.twinning.judgement import Judgement
from rt_torchrl.twinning.learners import Learner
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes


class Learning:
    """Lets the learner update its policy, and judges the update.

    Note: the paper keeps every update. A critic knows the value of actions near those that were taken. Where a training
    begins with a controller it explores little, and an actor that climbs the critic leaves those actions within one
    update. Plans and clones are judged alike.

    A learner that needs more than one interval in a row says so by ``shortest``; one that takes the first interval it
    is given for the start of an episode has a true ``from_the_start``.

    A learner that learns from the twin has a method ``take_twin(twin)``; one that asks how far the twin can be trusted
    has a method ``trust_twin(probability)`` and a true ``asks_for_trust``. One that wants to know of the real episodes
    that its policy flies has methods ``adopt()``, ``flown(cost)`` and ``grounded()``.

    Args:
        learner: learner of step 2.
        virtual: virtual episodes.
        taught: whether a learner that learns from the twin gets it, as in the arm ``twinning``.
    """

    def __init__(self, learner: Learner, virtual: VirtualEpisodes, *, taught: bool):
        self.learner, self.virtual = learner, virtual
        self._before: dict[str, Any] = {}
        self._after: dict[str, Any] | None = None  # weights of an update that has been judged
        take = getattr(learner, "take_twin", None)
        if taught and take is not None:
            take(virtual.twin)
        self._asks = taught and getattr(learner, "asks_for_trust", False)

    def trust(self, judge: Callable[[], RealJudge]) -> TensorDict:
        """Tell the learner, if it asks, how probably the twin is right about its policy.

        Args:
            judge: function that gives the judge by the evidence so far; it flies real episodes again, so that it is
                called only if needed.

        Returns:
            ``trust``, the probability that the twin says what the policy costs to within what matters.
        """
        if not self._asks:
            return findings()
        told: Any = self.learner
        probability = judge().trust(self.learner.policy, MATTERS)
        told.trust_twin(probability)
        return findings(trust=probability)

    def store(self, parts: Sequence[tuple[int, TensorDict]]) -> None:
        """Give the learner the transitions of the sound parts of an episode that it can use.

        Args:
            parts: number of the first interval, and the transitions, of each part.
        """
        shortest, bound = getattr(self.learner, "shortest", 1), getattr(self.learner, "from_the_start", False)
        for first, transitions in parts:
            over = bool(transitions["next", "terminated"][-1].any())  # with an end, few intervals are enough
            if (over or len(transitions) >= shortest) and not (bound and first):
                self.learner.store(transitions)

    def update(self) -> TensorDict:
        """Update the policy; see :meth:`Learner.update`."""
        self._before, self._after = copy.deepcopy(self.learner.policy.state_dict()), None
        return self.learner.update()

    @torch.no_grad()
    def judge(self, judged_on: Scenario, judgement: Judgement) -> TensorDict:
        """Go back to the policy before the update if the update is worse; the critic keeps what it has learned.

        Args:
            judged_on: virtual episodes on which both are flown.
            judgement: how both are judged.

        Returns:
            ``update_accepted``, and the reason if it is 0.

        Raises:
            DivergenceError: if the twin diverges with both and with the weights that have just flown.
        """
        policy = self.learner.policy
        self.adopt(policy)
        if self._after is not None:  # it was taken back under another closure
            policy.load_state_dict(self._after)
        after = self._after = copy.deepcopy(policy.state_dict())
        found = judgement.costs(policy, self.virtual, judged_on).expected
        policy.load_state_dict(self._before)
        earlier = judgement.costs(policy, self.virtual, judged_on).expected
        if not (math.isfinite(found) or math.isfinite(earlier)):
            policy.load_state_dict(after)  # an unsound twin judges nothing, and the step is repeated with another one
            judgement.track_record.require_sound_twin(self.virtual, judged_on)
            policy.load_state_dict(self._before)
        if judgement.worse(found, earlier):
            self.learner.restart()
            reason = f"update refused: J_a of model_free would be {found:.4g}, it was {earlier:.4g}"
            return findings(reason, update_accepted=0.0)
        policy.load_state_dict(after)
        return findings(update_accepted=1.0)

    def adopt(self, acting: nn.Module) -> None:
        """Tell the learner, if it wants to know, that its policy is to fly a real episode or is judged on the twin."""
        self._tell("adopt", acting)

    def flown(self, acted: nn.Module, cost: float) -> None:
        """Tell the learner, if it wants to know, what its policy has cost in a real episode.

        Args:
            acted: module that has acted in the episode.
            cost: J_a of the episode.
        """
        self._tell("flown", acted, cost)

    def grounded(self, waiting: nn.Module) -> None:
        """Tell the learner, if it wants to know, that its policy has not flown the episode, or not to its end."""
        self._tell("grounded", waiting)

    def _tell(self, what: str, acting: nn.Module, *values: float) -> None:
        told = getattr(self.learner, what, None)
        if told is not None and acting is self.learner.policy:
            told(*values)
