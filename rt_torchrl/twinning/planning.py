"""Step 5: the planner's plan, which stays unless the referee finds it worse."""

import contextlib
import copy
import math
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from rt_torchrl.optimisers.descent import Descended, by_small_steps
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.twinning.extreme_starts import astray
from rt_torchrl.twinning.findings import findings, merged
from rt_torchrl.twinning.judgement import Judgement
from rt_torchrl.twinning.planners import Planner, PlannerConfig
from rt_torchrl.twinning.scouts import GAINED, Scouts
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes
from rt_torchrl.twinning.way_back import WayBack


class Planning:
    """Lets the planner plan on some virtual episodes, and judges the plan on others.

    Note: the paper keeps every plan. Here a plan made on N_z winds is compared with the previous policy on N other
    winds, because the best policy for a few winds can lie just beyond a cliff of another wind. State feedback plans
    while it acts, so that there is nothing to compare.

    The attribute ``others`` holds further weights, from which the next plan is made, too; the best plan stays. A
    descent from the imitation of a controller may end in a minimum beside that controller. The attribute ``scouts``
    holds :class:`Scouts` of the policy, or None.

    Args:
        planner: planner of step 5.
        virtual: virtual episodes.
        config: parameters of step 5.
    """

    def __init__(self, planner: Planner, virtual: VirtualEpisodes, config: PlannerConfig):
        self.planner, self.virtual, self.config = planner, virtual, config
        self.scouts: Scouts | None = None
        # A copy of the policy descends over a short horizon, and goes on whether or not a plan gains anything.
        limit = math.inf if config.short_horizon.window else config.episode_gradient_limit
        self.way_back = WayBack(limit, config.anew)
        self.others: list[dict[str, Tensor]] = []
        self._first: list[dict[str, Tensor]] = []

    def plan(self, episode: int, planned_on: Scenario, judged_on: Scenario, judgement: Judgement) -> TensorDict:
        """Plan, and go back to the earlier weights if the plan is worse.

        Args:
            episode: number of the real episode, from 1.
            planned_on: virtual episodes of the plan; further rounds draw as many.
            judged_on: virtual episodes on which it is judged; further rounds draw as many.
            judgement: how it is judged.

        Raises:
            DivergenceError: if the twin diverges with the weights that have just flown.
        """
        withheld = self._recall(judged_on, judgement)
        found = self._from_the_present_or_earlier(planned_on, judged_on, judgement)
        while self.others:
            found, _ = self._also_from([self.others.pop()], found, planned_on, judged_on, judgement)
        if self.config.approach and episode == self.config.approach_at:
            found = self._approached(found, planned_on, judged_on, judgement)
        if self.scouts is not None and self.scouts.due(episode):
            found = self._scouted(self.scouts.best(episode, planned_on), found, planned_on, judged_on, judgement)
        found = merged(found, findings(recalled=float(withheld is not None)))
        if withheld is not None:
            found.update(findings(withheld=max(withheld, float(found.get("withheld", 0.0)))))
        for _ in range(self.config.rounds - 1):
            planned_on, judged_on = (self.virtual.draw(len(each.initial_state)) for each in (planned_on, judged_on))
            further = self._from_the_present(planned_on, judged_on, judgement)
            found = merged(found, further) if further["plan_accepted"] else found
        refuted = self._refuted(judgement)
        if refuted:
            found.update(findings(withheld=max(refuted, float(found.get("withheld", 0.0)))))
        return merged(found, self._raised(planned_on))

    @torch.no_grad()
    def _raised(self, episodes: Scenario) -> TensorDict:
        """Raise the multipliers by the excess of the policy that stays, once all plans of this episode are judged.

        Plans and what they would replace are so compared at the same price. What a refused plan exceeds is no matter.
        """
        constraints = self.virtual.constraints
        if not constraints:
            return findings()
        # Further rounds may have drawn episodes in which the twin diverges: these say nothing of a bound.
        with contextlib.suppress(FloatingPointError):
            constraints.update(self.virtual.twin.control(self.planner.policy, *episodes))
        return findings(**constraints.report())

    def _refuted(self, judgement: Judgement) -> float:
        """What flights of earlier weights refute, wherever the plan of this episode lies."""
        policy, evidence = self.planner.policy, judgement.evidence
        return 0.0 if evidence is None or isinstance(policy, StateFeedback) else evidence.refuted(policy)

    def _recall(self, judged_on: Scenario, judgement: Judgement) -> float | None:
        """Go back to weights that have flown and are expected to cost less, and say what that withholds."""
        policy, evidence = self.planner.policy, judgement.evidence
        if evidence is None or isinstance(policy, StateFeedback):
            return None
        recalled = evidence.recalled(policy, judged_on)
        if recalled is None:
            return None
        left = judgement.costs(policy, self.virtual, judged_on)
        policy.load_state_dict(recalled)
        self.planner.restart()
        return left.withheld(judgement.costs(policy, self.virtual, judged_on))

    def _approached(
        self, found: TensorDict, planned_on: Scenario, judged_on: Scenario, judgement: Judgement
    ) -> TensorDict:
        """The best plan by small steps from the present weights and from the first ones, or the plan found so far."""
        begins = [self.planner.policy.state_dict(), *self._first]
        approach = self.config.approach
        found, accepted = self._also_from(begins, found, planned_on, judged_on, judgement, approach=approach)
        self._first.clear()
        return merged(found, findings(approached=float(accepted)))

    def _scouted(
        self,
        scout: dict[str, Tensor],
        found: TensorDict,
        planned_on: Scenario,
        judged_on: Scenario,
        judgement: Judgement,
    ) -> TensorDict:
        """The plan from the best scout, if it saves enough, or the plan found so far and the planner as it was."""
        before = copy.deepcopy(self.planner.state_dict())
        found, better = self._also_from([scout], found, planned_on, judged_on, judgement, gained=GAINED)
        if not better:
            self.planner.load_state_dict(before)
        return merged(found, findings(scouted=float(better)))

    def remember(self) -> None:
        """Plan from the present weights, too, the next time; state feedback has none."""
        if not isinstance(self.planner.policy, StateFeedback):
            weights = copy.deepcopy(self.planner.policy.state_dict())
            self.others.append(weights)
            if self.config.approach:
                self._first.append(weights)

    def state_dict(self) -> dict[str, Any]:
        """The weights that later plans will begin with; ``others`` is empty after each episode."""
        return {"first": list(self._first), "way_back": self.way_back.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of a planning with the same planner."""
        self._first = list(state["first"])
        self.way_back.load_state_dict(state["way_back"])

    def _also_from(
        self,
        begins: list[dict[str, Tensor]],
        found: TensorDict,
        planned_on: Scenario,
        judged_on: Scenario,
        judgement: Judgement,
        *,
        approach: int = 0,
        gained: float = 0.0,
    ) -> tuple[TensorDict, bool]:
        """The best plan from other weights or the plan found so far, and whether it is from others."""
        better = False
        for weights in begins:
            further = self._from_others(weights, planned_on, judged_on, judgement, approach=approach, gained=gained)
            found, better = (found, better) if further is None else (further, True)
        return found, better

    def _from_others(
        self,
        weights: dict[str, Tensor],
        planned_on: Scenario,
        judged_on: Scenario,
        judgement: Judgement,
        *,
        approach: int = 0,
        gained: float = 0.0,
    ) -> TensorDict | None:
        """A plan that begins with other weights; None, and the present policy as it is, unless the plan is better.

        It is if it saves more than a share ``gained`` of the cost.
        """
        policy = self.planner.policy
        best, stays = copy.deepcopy(policy.state_dict()), judgement.costs(policy, self.virtual, judged_on)
        tail = self.virtual.tail(policy, judged_on)
        policy.load_state_dict(weights)
        self.planner.restart()
        try:
            if approach:
                by_small_steps(policy, lambda: self._priced(policy, planned_on), approach)
            found = self.planner.plan(planned_on)
        except FloatingPointError:
            found = None  # the twin is sound with the present policy, so that these weights are to blame
        if found is not None:
            plan = judgement.costs(policy, self.virtual, judged_on)
            if saves(plan.expected, stays.expected, gained) and not astray(
                self.virtual.tail(policy, judged_on), tail, cost=plan.twin, usual=stays.twin
            ):
                return planned(found)
        policy.load_state_dict(best)
        self.planner.restart()
        return None

    def _priced(self, policy: nn.Module, episodes: Scenario) -> Tensor:
        """The mean J_a with the price of leaving the bounds, if there are some, for a descent."""
        twin, constraints = self.virtual.twin, self.virtual.constraints
        return constraints.costs(twin, policy, episodes).mean() if constraints else twin.cost(policy, *episodes)

    def _from_the_present_or_earlier(
        self, planned_on: Scenario, judged_on: Scenario, judgement: Judgement
    ) -> TensorDict:
        """A plan from the present weights and, if it is an early one or stuck, from earlier ones; the best stays."""
        policy = self.planner.policy
        if isinstance(policy, StateFeedback):
            return self._from_the_present(planned_on, judged_on, judgement)
        began = copy.deepcopy(policy.state_dict())
        found = self._from_the_present(planned_on, judged_on, judgement)
        earlier = self.way_back.after(found, began, policy)
        found, led_back = self._also_from(earlier, found, planned_on, judged_on, judgement)
        return merged(found, findings(led_back=float(led_back)))

    def _from_the_present(self, planned_on: Scenario, judged_on: Scenario, judgement: Judgement) -> TensorDict:
        """A plan from the present weights; one that fails from extreme starts is made again on these, too."""
        policy = self.planner.policy
        if isinstance(policy, StateFeedback):
            return self._descended(planned_on, planned_on, judgement)
        before, tail = copy.deepcopy(policy.state_dict()), self.virtual.tail(policy, judged_on)
        incumbent = judgement.costs(policy, self.virtual, judged_on)
        if not math.isfinite(incumbent.twin):
            judgement.track_record.require_sound_twin(self.virtual, judged_on)
        failed = 0.0
        for episodes in (planned_on, self.virtual.with_extremes(planned_on)):
            found = self._descended(episodes, planned_on, judgement)
            if not found["plan_accepted"]:
                return found
            plan = judgement.costs(policy, self.virtual, judged_on)
            if judgement.worse(plan.expected, incumbent.expected):
                break
            if not astray(self.virtual.tail(policy, judged_on), tail, cost=plan.twin, usual=incumbent.twin):
                return self._with_failure(found, failed)
            failed = 1.0
            policy.load_state_dict(before)
            self.planner.restart()
        policy.load_state_dict(before)
        self.planner.refuse()
        refused = found.update(findings(plan_accepted=0.0, J_a_plan=found["J_a_plan_before"]))
        return self._with_failure(merged(refused, findings(withheld=plan.withheld(incumbent))), failed)

    def _with_failure(self, found: TensorDict, failed: float) -> TensorDict:
        """A report, and whether a plan has failed from extreme starts if there are any."""
        return merged(found, findings(astray=failed)) if self.virtual.extremes else found

    def _descended(self, episodes: Scenario, usual: Scenario, judgement: Judgement) -> TensorDict:
        """The report of a plan, or why there is none; the policy then has its earlier weights.

        The twin must be sound in the usual episodes alone: what has just flown may diverge from extreme starts.
        """
        policy = self.planner.policy
        before = copy.deepcopy(policy.state_dict())
        try:
            return planned(self.planner.plan(episodes))
        except FloatingPointError as error:
            judgement.track_record.require_sound_twin(self.virtual, usual)
            policy.load_state_dict(before)
            self.planner.restart()
            return findings(f"no plan: {error}", plan_accepted=0.0)


def planned(found: Descended) -> TensorDict:
    """The report of a plan that is kept."""
    return findings(J_a_plan_before=found.start, J_a_plan=found.best, policy_gradient=found.gradient, plan_accepted=1.0)


def saves(cost: float, of: float, share: float) -> bool:
    """Whether a cost is lower than another one by more than a share of that."""
    return cost < of if math.isinf(of) else of - cost > share * abs(of)
