"""Step 2 as the algorithm takes it: the learner's update, which is undone if the twin finds it worse."""

import copy
import math
from collections.abc import Mapping

from tensordict import TensorDict
from torch import nn

from rt_torchrl.twinning.config import TwinningConfig
from rt_torchrl.twinning.findings import findings, merged
from rt_torchrl.twinning.learners import Learner
from rt_torchrl.twinning.planners import Planner
from rt_torchrl.twinning.referees import Role
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes


class Improvement:
    """Lets the learner improve π_mf, and judges the update on virtual episodes if so configured.

    A learner that learns from the twin has a method ``take_twin(twin)``, which is called in the arm ``twinning``; one
    that wants to know of the real episodes that its policy flies has methods ``adopt()`` and ``flown(cost)``.

    Args:
        learner: learner of step 2.
        virtual: virtual episodes.
        config: configuration of the algorithm, whose ``learner.worst_update`` says which updates are undone.
    """

    def __init__(self, learner: Learner, virtual: VirtualEpisodes, config: TwinningConfig):
        self.learner, self.virtual = learner, virtual
        self.worst, self.count = config.learner.worst_update, config.virtual_episodes
        take = getattr(learner, "take_twin", None)
        if take is not None and config.arm == "twinning":
            take(virtual.twin)

    def update(self) -> TensorDict:
        """Improve the policy.

        Returns:
            What the learner reports and, of an update that was judged, ``update_cost_ratio``.
        """
        if not math.isfinite(self.worst) or not self.virtual.processes:
            return self.learner.update()
        policy, episodes = self.learner.policy, self.virtual.draw(self.count)
        weights, before = copy.deepcopy(policy.state_dict()), self.virtual.cost(policy, episodes).item()
        found = self.learner.update()
        self.adopt(policy)
        after = self.virtual.cost(policy, episodes).item()
        report = merged(found, findings(update_cost_ratio=after / before))
        if after <= self.worst * before:
            return report
        policy.load_state_dict(weights)
        self.learner.restart()
        return merged(
            report, findings(f"update undone: on the twin its J_a is {after:.4g}, that of before {before:.4g}")
        )

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

    def _tell(self, what: str, acting: nn.Module, *values: float) -> None:
        told = getattr(self.learner, what, None)
        if told is not None and acting is self.learner.policy:
            told(*values)


def require_own_policies(policies: Mapping[Role, nn.Module], trained: Mapping[Role, Learner | Planner]) -> None:
    """Refuse a learner or planner that trains another policy than that of its role.

    Raises:
        ValueError: if there is one; it names the role.
    """
    for role, part in trained.items():
        if part.policy is not policies[role]:
            raise ValueError(f"{type(part).__name__} trains another policy than {role}; build it with that module.")
