"""A flight on the real system, in step 1."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from rt_torchrl.systems.exploration import LivePolicy
from rt_torchrl.systems.refusal import note_refusal
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.twinning.findings import findings


class Flight(NamedTuple):
    """A real episode that can be learned from.

    Attributes:
        transitions: its transitions, whose action is the applied one.
        record: its trajectory.
        refused: why earlier attempts could not be learned from.
    """

    transitions: TensorDict
    record: Trajectory
    refused: list[str]

    @property
    def cost(self) -> Tensor:
        """J_a as measured."""
        return -self.transitions["next", "reward"].mean()

    def report(self) -> TensorDict:
        """The cost, and how often and why the episode was flown again."""
        found = findings(real_cost=self.cost, reward=-self.cost)
        if self.refused:
            found.update(findings(episodes_refused=float(len(self.refused))))
            found.set_non_tensor("refusal", "; ".join(self.refused))
        return found


def fly(actor: LivePolicy, rollout: Callable[[], TensorDict], policy: nn.Module, *, strength: float) -> Flight:
    """Fly one episode on the real system, and again if it cannot be learned from.

    Args:
        actor: what acts in the rollout.
        rollout: function that flies one episode of batch size 1.
        policy: policy that acts.
        strength: strength ξ of the exploration.

    Raises:
        ValueError: if several episodes in a row cannot be learned from.
    """
    refused: list[str] = []
    while True:
        actor.begin(policy, strength=strength)
        episode = rollout()[0]
        if not note_refusal(refused, episode):
            break
    # The learner learns from the action that was applied.
    episode["action"] = episode["next", "applied"]
    states = torch.cat([episode["state"], episode["next", "state"][-1:]])
    return Flight(episode, Trajectory(states, episode["action"], episode["exogenous"]), refused)
