"""Step 2: the learner's update, which step 6 can take back where it is worse."""

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict

from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.learn import Learner
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.twinning.findings import findings


class Learning:
    """Lets the learner update its policy, and judges the update.

    Note: the paper keeps every update. A critic knows the value of actions near those that were taken. Where a training
    begins with a controller it explores little, and an actor that climbs the critic leaves those actions within one
    update. Plans and clones are judged alike.

    A learner that needs more than one interval in a row says so by ``shortest``.

    Args:
        learner: learner of step 2.
        virtual: virtual episodes.
    """

    def __init__(self, learner: Learner, virtual: VirtualEpisodes):
        self.learner, self.virtual = learner, virtual
        self._before: dict[str, Any] = {}
        self._after: dict[str, Any] | None = None  # weights of an update that has been judged

    def store(self, parts: Sequence[TensorDict]) -> None:
        """Give the learner the transitions of the sound parts of an episode that it can use.

        Args:
            parts: the transitions of each part.
        """
        shortest = getattr(self.learner, "shortest", 1)
        for transitions in parts:
            over = bool(transitions["next", "terminated"][-1].any())  # with an end, few intervals are enough
            if over or len(transitions) >= shortest:
                self.learner.store(transitions)

    def update(self) -> TensorDict:
        """Update the policy; see :meth:`Learner.update`."""
        self._before, self._after = copy.deepcopy(self.learner.policy.state_dict()), None
        return self.learner.update()

    @torch.no_grad()
    def judge(self, judged_on: Scenario, belief: Belief) -> TensorDict:
        """Go back to the policy before the update if that is expected to cost less; the critic keeps what it learned.

        Args:
            judged_on: virtual episodes on which both are flown.
            belief: what policies cost.

        Returns:
            ``update_accepted``, and the reason if it is 0.

        Raises:
            DivergenceError: if the twin diverges with both and with the weights that have just flown.
        """
        policy = self.learner.policy
        if self._after is not None:  # it was taken back under another closure
            policy.load_state_dict(self._after)
        after = self._after = copy.deepcopy(policy.state_dict())
        found = belief.judge(policy, judged_on)
        policy.load_state_dict(self._before)
        earlier = belief.judge(policy, judged_on)
        if not (math.isfinite(found.price) or math.isfinite(earlier.price)):
            policy.load_state_dict(after)  # an unsound twin judges nothing, and the step is repeated with another one
            belief.require_sound_twin(judged_on)
            policy.load_state_dict(self._before)
        if found > earlier:
            self.learner.restart()
            reason = f"update refused: J_a of model_free would be {found.price:.4g}, it was {earlier.price:.4g}"
            return findings(reason, update_accepted=0.0)
        policy.load_state_dict(after)
        return findings(update_accepted=1.0)
