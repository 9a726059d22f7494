"""Step 6: a referee says which policy acts next, and whether the idle one becomes a clone of it."""

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase

from rt_torchrl.steps.config import ROLES, RefereeConfig, Role
from rt_torchrl.steps.imitation import Imitation
from rt_torchrl.steps.learn import Learner
from rt_torchrl.steps.plan import Planner
from rt_torchrl.steps.report import Step, merged, metrics, record_of

Event = Literal["keep", "swap", "clone"]
STALL = 0.5
"""Relative weight change T_w below which the idle policy has stalled; P_w decides how soon that makes it a clone."""


def other_than(role: Role) -> Role:
    """The other one of the two roles."""
    return "model_based" if role == "model_free" else "model_free"


class Evidence(NamedTuple):
    """Evidence about the two policies after an episode.

    Args:
        live_cost: cost of the live policy over the virtual episodes: what it is expected to cost on the real system or,
            with the paper's rule, mean J_a on the twin.
        idle_cost: the same of the idle policy over the same virtual episodes; infinite if the twin diverges with it.
        idle_weight_change: relative change ‖w^i − w^{i−1}‖/‖w^i‖ of the idle policy's weights over this episode.
    """

    live_cost: float
    idle_cost: float
    idle_weight_change: float


@runtime_checkable
class Referee(Protocol):
    """A referee, which names the policy that acts on the real system.

    ``docs/referee.md`` shows how to write one.
    """

    live: Role
    """Role that acts in the next real episode."""

    def decide(self, evidence: Evidence) -> Event:
        """Judge the policies after an episode, and swap their roles if that is the decision.

        Returns:
            ``swap`` if the roles have swapped, ``clone`` if the live policy is to be cloned into the idle one, ``keep``
            otherwise.
        """

    def state_dict(self) -> dict[str, Any]:
        """The live role and everything else that the next decision depends on, as plain values."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a :meth:`state_dict`."""


class ExpectedCost:
    """The policy acts that costs less; the idle one becomes a clone when it has stalled for long.

    Two policies of equal cost never change roles.

    Args:
        config: parameters of step 6.
        live: role that starts live; the paper starts with the model-free policy.
    """

    def __init__(self, config: RefereeConfig, live: Role = "model_free"):
        self.config = config
        self.live: Role = live
        self.stall_count = 0  # C_w

    def decide(self, evidence: Evidence) -> Event:
        if evidence.idle_cost < evidence.live_cost:
            self.live, self.stall_count = other_than(self.live), 0
            return "swap"
        return self._stalled(evidence.idle_weight_change)

    def _stalled(self, idle_weight_change: float) -> Event:
        """Count stalled episodes: ``clone`` if there are more in a row than ``clone_patience``, else ``keep``."""
        self.stall_count = self.stall_count + 1 if idle_weight_change < STALL else 0
        if self.stall_count > self.config.clone_patience:
            self.stall_count = 0
            return "clone"
        return "keep"

    def state_dict(self) -> dict[str, Any]:
        """The live role and all counters."""
        return {name: value for name, value in vars(self).items() if name != "config"}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        vars(self).update(state)


class DecisionTree(ExpectedCost):
    """The paper's decision tree (figure decisionTree).

    The roles swap when the live policy has been worse on the twin for more than P_π episodes in a row. Otherwise the
    idle policy becomes a clone when it has stalled for more than P_w episodes in a row. Each counter restarts when its
    condition fails; the second counter also restarts while the live policy is worse.

    Note: the paper prints J_live/J_idle < T_J for "the live policy performs worse". Here the condition is >, because a
    smaller cost is better; T_J is 1, as in all test cases of the paper.
    """

    def __init__(self, config: RefereeConfig, live: Role = "model_free"):
        super().__init__(config, live)
        self.worse_count = 0  # C_π

    def decide(self, evidence: Evidence) -> Event:
        worse = not math.isfinite(evidence.live_cost) or evidence.live_cost > evidence.idle_cost
        if not worse:
            self.worse_count = 0
            return self._stalled(evidence.idle_weight_change)
        self.worse_count, self.stall_count = self.worse_count + 1, 0
        if self.worse_count > self.config.patience:
            self.worse_count = 0
            self.live = other_than(self.live)
            return "swap"
        return "keep"


def make_referee(config: RefereeConfig, live: Role) -> Referee:
    """The referee that a configuration names; the role ``live`` starts live."""
    return DecisionTree(config, live) if config.rule == "decision_tree" else ExpectedCost(config, live)


MakeReferee = Callable[[RefereeConfig, Role], Referee]
"""Function of a configuration and the role that starts live that makes the referee of step 6."""


class Switch(Step):
    """Step 6: the referee decides by what both policies cost over the same N virtual episodes.

    Reads ``live``, ``record`` and the relative ``weight_changes`` of both policies. Writes ``event``,
    ``J_a_model_based`` and ``J_a_model_free`` on the twin, and reports what both are ``expected`` to cost.

    Args:
        referee: the referee.
        imitation: clones, which know what policies cost, and the number N of virtual episodes.
        learner: learner, which knows observations of the real system.
        planner: planner; the one of both whose policy becomes a clone starts afresh.
    """

    in_keys = ["live", "record", ("weight_changes", "model_free"), ("weight_changes", "model_based")]
    out_keys = ["event", "J_a_model_based", "J_a_model_free"]

    def __init__(self, referee: Referee, imitation: Imitation, learner: Learner, planner: Planner):
        super().__init__(referee=referee)
        self.referee, self.imitation, self.belief = referee, imitation, imitation.belief
        self.learner, self.planner = learner, planner

    @torch.no_grad()
    def forward(self, episode: TensorDictBase) -> TensorDictBase:
        """Take the step.

        Raises:
            DivergenceError: if the twin diverges under the weights that have just flown, too.
        """
        belief, live = self.belief, self.referee.live
        judged_on, idle = belief.virtual.draw(self.imitation.count), other_than(live)
        costs = {role: belief.judge(belief.policies[role], judged_on) for role in ROLES}
        diverged = [f"{role} diverges on the twin" for role in ROLES if not math.isfinite(costs[role].on_twin)]
        if diverged:
            belief.require_sound_twin(judged_on)
        # Weights whose step was left out, because the twin diverged, are as they were.
        change = float(episode.get(("weight_changes", idle), 0.0))
        event = self.referee.decide(Evidence(costs[live].expected, costs[idle].expected, change))
        entries = {f"J_a_{role}": costs[role].on_twin for role in ROLES}
        if belief.corrects:
            entries |= {f"expected/{role}": costs[role].expected for role in ROLES}
        report = metrics(*diverged, **entries, weight_change=change, event=event)
        if event == "clone":
            policies, record = (belief.policies[live], belief.policies[idle]), record_of(episode)
            if episode["live"] != live:  # another one flew, whose actions say nothing of this one
                record = record.part(0, 0, 0.0)
            cloned = self.imitation.clone(*policies, seen=self.learner.observations, record=record, judged_on=judged_on)
            if "reason" not in cloned:
                (self.learner if idle == "model_free" else self.planner).restart()
            report = merged(report, cloned)
        return merged(episode, report)
