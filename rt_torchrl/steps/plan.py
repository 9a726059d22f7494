"""Step 5: the planner improves π_mb on the twin from several starts; what is expected to cost least stays."""

import copy
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn.utils import get_total_norm, parameters_to_vector

from rt_torchrl.control.predictive_control import PredictiveControl
from rt_torchrl.optimisers.descent import Descended, Descent, limited_mean
from rt_torchrl.optimisers.simplex import by_simplex, searched
from rt_torchrl.steps.belief import Belief, Judged, equal
from rt_torchrl.steps.config import PlannerConfig
from rt_torchrl.steps.inputs import both
from rt_torchrl.steps.report import Step, in_words, merged, metrics, same_architecture, weight_change
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.trajectories.twin import DigitalTwin

Weights = dict[str, Tensor]
SEVERAL = (1, 2, 4)
"""Episodes in which plans have several starts; later ones gained nothing on eight systems."""
GRADIENT_LIMIT = 10.0
"""Limit κ of the gradient of each virtual episode, see :func:`limited_mean`, in a second descent over whole episodes
where the first one gains nothing beside a mean gradient that is longer."""
SEARCHED = 40
"""Number of costs for each weight of a search without gradients."""
DEAREST = 5
"""Number of judged episodes with which a plan that is refused is made again, where they may end early."""
NOTHING = 1e-3
"""Share of a cost that a descent must gain, where its gradient promises much more."""
STRIDE = 1_000_003
"""Difference of the seeds of the random policies of two episodes."""
SEEDS = 2**63
"""Number of seeds of a generator."""
DESCENT = ("J_a_plan_before", "J_a_plan", "policy_gradient")
"""What the report of a plan says of its descent."""


@runtime_checkable
class Planner(Protocol):
    """A planner, which improves π_mb on the twin.

    ``docs/planner.md`` shows how to write one.
    """

    policy: nn.Module
    """Policy π_mb, updated in place."""

    def plan(self, episodes: Scenario) -> Descended:
        """Improve the policy on these virtual episodes; the algorithm then judges it on others.

        Returns:
            Mean cost on ``episodes`` before and after, the norm of the first gradient, and the number of iterations.

        Raises:
            DivergenceError: if the twin diverges with the present policy.
        """

    def restart(self) -> None:
        """Forget everything that belongs to the policy's earlier weights, because the policy's weights have jumped."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next plan depends on, except the policy's weights: tensors in plain containers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of a planner with the same configuration."""


class WholeEpisodes(Descent):
    r"""Descends :math:`J_a = \mathbb E\frac1{T_o}\int L_a\,dt` over the weights of π_mb, on the twin (paper, eq. J_a).

    Where real episodes contradict the twin, what it expects on the real system is descended instead. Where episodes may
    end early, which gradients do not see, the simplex of Nelder and Mead searches on from there: all weights of a small
    policy, or those of the output layer.

    Args:
        twin: twin with the best closure so far, w_p*.
        policy: policy π_mb, updated in place.
        config: parameters of step 5.
    """

    def __init__(self, twin: DigitalTwin, policy: nn.Module, config: PlannerConfig):
        super().__init__(policy, config.descent)
        self.twin, self.policy, self.options = twin, policy, config
        ends = twin.plant.end_cost is not None and config.method != "single_start"
        self.searched = searched(policy) if ends else []
        """Weights that the simplex searches from where a descent ends."""

    def plan(self, episodes: Scenario) -> Descended:
        """Take n_mb gradients, and as many limited ones where they gain nothing; the policy keeps the best weights."""
        count = self.options.iterations
        descended = self.run(lambda: self._cost(episodes, math.inf), count)
        if self.stalled(descended.start, descended.best, descended.gradient):
            again = self.run(lambda: self._cost(episodes, GRADIENT_LIMIT), count)
            descended = descended._replace(best=again.best, iterations=descended.iterations + again.iterations)
        if self.searched and count:
            best = by_simplex(self.searched, lambda: self._cost(episodes, math.inf), SEARCHED, size=0.3)
            descended = descended._replace(best=best)
            self.restart()  # the weights have jumped
        return descended

    def stalled(self, before: float, after: float, gradient: float) -> bool:
        r"""Whether a plan gained nothing, although its first gradient promised more than is believable.

        It promises :math:`\|g\|\,\|w\|`, the change of the cost if the weights change by their norm along it.
        """
        if self.options.method == "single_start":
            return False
        promised = gradient * get_total_norm([w.detach() for w in self.policy.parameters() if w.requires_grad]).item()
        return before - after <= NOTHING * abs(before) and promised > GRADIENT_LIMIT * abs(before)

    def _cost(self, episodes: Scenario, limit: float) -> Tensor:
        costs = self.twin.expected_costs(self.policy, *episodes)
        return limited_mean(costs, self.policy.parameters(), limit)


class RecedingHorizonPlanner:
    """Fits the forecast of model predictive control to the inputs that have been met.

    The controller plans on the twin's closure itself, and so follows step 4 at once.

    Args:
        twin: twin on which the controller plans.
        policy: the controller, which acts in the place of π_mb.
        config: parameters of step 5.
    """

    policy: nn.Module

    def __init__(self, twin: DigitalTwin, policy: PredictiveControl, config: PlannerConfig):
        self.twin, self.policy, self.config, self._learn = twin, policy, config, policy.learn

    def plan(self, episodes: Scenario) -> Descended:
        """Fit the forecast to the inputs of the episodes; the cost before is the cost after, without a gradient."""
        self._learn(episodes.exogenous)
        count = self.config.receding_horizon.virtual_episodes
        cost = self.twin.cost(self.policy, episodes.initial_state[:count], episodes.exogenous[:count]).item()
        return Descended(cost, cost, 0.0, 0)

    def restart(self) -> None:
        """Do nothing: there are no weights, and the controller plans on the closure as it is."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing: the forecast belongs to the controller."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Do nothing."""


def make_planner(twin: DigitalTwin, policy: nn.Module, config: PlannerConfig) -> Planner:
    """The planner of a configuration; see :class:`PlannerConfig` for the methods.

    Args:
        twin: twin on which the policy is planned.
        policy: policy π_mb, updated in place.
        config: parameters of step 5.

    Raises:
        ValueError: if the method is receding_horizon and the policy is not :class:`PredictiveControl` on the closure of
            the twin, or the other way round.
    """
    other = isinstance(policy, PredictiveControl) and policy.closure is not twin.closure
    if other or isinstance(policy, PredictiveControl) != (config.method == "receding_horizon"):
        raise ValueError(
            f"method={config.method!r} of the planning does not go with a policy of class {type(policy).__name__}: "
            "receding_horizon needs model_based=PredictiveControl(twin.plant, twin.closure, ...), and it alone."
        )
    if isinstance(policy, PredictiveControl):
        return RecedingHorizonPlanner(twin, policy, config)
    return WholeEpisodes(twin, policy, config)


MakePlanner = Callable[[DigitalTwin, nn.Module, PlannerConfig], Planner]
"""Function that makes the planner of step 5; :func:`make_planner` describes the arguments."""


class Plan(NamedTuple):
    """Weights that a descent ended at, what they cost on other virtual episodes, and the report of the descent."""

    weights: Weights
    cost: Judged
    report: TensorDict


class MultiStart(Step):
    """Step 5: plans from several starts on some virtual episodes are judged on others; the best one stays.

    Reads ``number``, ``J_p`` and ``large_scale``: the twin must have been fitted, and inputs be drawn. Writes
    ``weight_changes/model_based`` and a report.

    A descent begins with the present weights. In the episodes 1, 2 and 4, and where gradients explode in the first plan
    that gains nothing or is refused, the second, the fourth and so on, it also begins with the best of some random
    policies, and with those weights of the last that have flown that are expected to cost least. Where real episodes
    contradict the twin, a descent begins with the latter in every episode in which they are expected to cost less than
    the present ones, and they stay as they are if they are expected to cost less than every plan.

    Note: the paper keeps every plan, as ``single_start`` does. Here a plan made on N_z winds is compared with the
    previous policy on N other winds, because the best policy for a few winds can lie just beyond a cliff of another
    wind. State feedback plans while it acts, so that there is nothing to compare.

    Random policies have random numbers of their own, so that a training whose plan they do not improve is the same
    without them.

    Args:
        planner: planner of step 5.
        belief: what policies cost on the real system, and the virtual episodes.
        config: parameters of step 5.
        counts: numbers of virtual episodes that plans are made on, and judged on.
        make_policy: function that draws a random policy of the same architecture; None for that of the plant, if its
            policies have the same architecture, and else for no random policies.

    Raises:
        ValueError: if it draws policies of another architecture.
    """

    in_keys = ["number", "J_p", "large_scale"]
    out_keys = [("weight_changes", "model_based")]

    def __init__(
        self,
        planner: Planner,
        belief: Belief,
        config: PlannerConfig,
        counts: tuple[int, int],
        make_policy: Callable[[torch.Generator], nn.Module] | None = None,
    ):
        super().__init__(planner=planner)
        self.planner, self.belief, self.virtual, self.counts = planner, belief, belief.virtual, counts
        self.recorded, fed_back = config.method == "single_start", isinstance(planner.policy, StateFeedback)
        self.judges = not self.recorded and not fed_back
        """Whether plans are compared; else every one is kept."""
        self.count = config.starts if config.method == "multi_start" and not fed_back else 0
        self.make_policy = make_policy or self.virtual.twin.plant.make_policy
        self._stalled = 0
        device = self.virtual.generator.device
        drawn = self.make_policy(torch.Generator(device=device)) if self.count else planner.policy
        self.alike = same_architecture(drawn, planner.policy)
        if make_policy is not None and not self.alike:
            raise ValueError(
                f"make_policy draws a {type(drawn).__name__}, and model_based is another "
                f"{type(planner.policy).__name__}; let it draw random policies like that one, or use starts=0."
            )

    def forward(self, episode: TensorDictBase) -> TensorDictBase:
        """Take the step."""
        policy = self.planner.policy
        weights = parameters_to_vector(policy.parameters()).detach()
        planned_on = self.virtual.draw(self.counts[0], recorded=self.recorded)
        judged_on = self.virtual.draw(self.counts[1]) if self.judges else planned_on
        report = self.plan(int(episode["number"]) + 1, planned_on, judged_on)
        return merged(episode, report).set(("weight_changes", "model_based"), weight_change(policy, weights))

    def plan(self, episode: int, planned_on: Scenario, judged_on: Scenario) -> TensorDict:
        """Plan; the policy gets the weights that are expected to cost least.

        Args:
            episode: number of the real episode, from 1.
            planned_on: virtual episodes of the plans.
            judged_on: virtual episodes on which they are judged.

        Raises:
            DivergenceError: if the twin diverges with the weights that have just flown.
        """
        policy = self.planner.policy
        if not self.judges:
            return self._descended(planned_on, planned_on)
        present = copy.deepcopy(policy.state_dict())
        self.belief.require_sound_twin(judged_on)
        before = self.belief.judge(policy, judged_on)
        best = self._from_the_present(present, before, planned_on, judged_on)
        several = self._several(episode, best)
        corrected = isinstance(self.planner, WholeEpisodes) and self.belief.corrects and self.belief.contradicted
        flown = self.belief.best_flown(policy, judged_on) if several or corrected else None
        others: dict[int, Weights] = {}
        if several and self.alike:
            others[1] = self._random(episode, planned_on)
        if flown is not None and (several or flown[1] < before):
            others[2] = flown[0]
        if several or others:
            new = {number: weights for number, weights in others.items() if not equal(weights, present)}
            best = self._best(best, new, planned_on, judged_on)
        if flown is not None and corrected and flown[1] < best.cost:
            best = Plan(*flown, metrics(plan_accepted=0.0, recalled=1.0))
            policy.load_state_dict(best.weights)
            self.planner.restart()
        # Of episodes that plans were not made on: those of a plan that was made again are dear.
        return best.report.update(metrics(J_a_plan_before=before.on_twin, J_a_plan=best.cost.on_twin))

    def _best(self, best: Plan, others: Mapping[int, Weights], planned_on: Scenario, judged_on: Scenario) -> Plan:
        """The best of a plan and of those from other weights, by the number of their start; the policy gets it."""
        after, start = copy.deepcopy(self.planner.state_dict()), 0
        policy = self.planner.policy
        for number, weights in others.items():
            policy.load_state_dict(weights)
            self.planner.restart()
            try:
                report = planned(self.planner.plan(planned_on))
            except FloatingPointError:
                continue  # the twin is sound with the present policy, so that these weights are to blame
            cost = self.belief.judge(policy, judged_on)
            if cost < best.cost:
                best, start = Plan(copy.deepcopy(policy.state_dict()), cost, report), number
        policy.load_state_dict(best.weights)
        if start:
            self.planner.restart()
        else:
            self.planner.load_state_dict(after)
        return best._replace(report=best.report.update(metrics(start=float(start))))

    def _from_the_present(self, present: Weights, before: Judged, planned_on: Scenario, judged_on: Scenario) -> Plan:
        """A plan from the present weights, or these where it is expected to cost more.

        A plan that fails from extreme starts alone is made again on these, too. Where episodes may end early, one that
        is refused is made again with those of the others in which it was dearest: the few that it was made on do not
        hold a rare end.
        """
        policy, episodes = self.planner.policy, planned_on
        while True:
            report = self._descended(episodes, usual=planned_on)
            if not report["plan_accepted"]:
                return Plan(present, before, report)
            cost = self.belief.judge(policy, judged_on)
            if cost <= before and math.isfinite(cost.on_twin):
                return Plan(copy.deepcopy(policy.state_dict()), cost, report)
            first = episodes is planned_on  # the plan still has its weights
            further = self._further(cost, before, planned_on, judged_on) if first else None
            policy.load_state_dict(present)
            self.planner.restart()
            if further is None:
                costs = f"{in_words(cost.expected, 4)}, the present weights {in_words(before.expected, 4)}"
                reason = f"the plan is expected to cost {costs}"
                refused = metrics(reason, plan_accepted=0.0, J_a_plan=report["J_a_plan_before"])
                return Plan(present, before, report.update(refused))
            episodes = further

    @torch.no_grad()
    def _further(self, cost: Judged, before: Judged, planned_on: Scenario, judged_on: Scenario) -> Scenario | None:
        """The episodes on which a plan that is refused is made again; None where none of them says why it fails."""
        twin = self.virtual.twin
        if twin.plant.end_cost is None:
            fails = len(self.virtual.extremes) and cost.on_twin <= before.on_twin
            return self.virtual.with_extremes(planned_on) if fails else None
        if not math.isfinite(cost.on_twin):
            return None
        costs = twin.episode_costs(self.planner.policy, *judged_on)
        dearest = costs.topk(min(DEAREST, len(costs))).indices
        return both(planned_on, Scenario(*(values[dearest] for values in judged_on)))

    def _descended(self, episodes: Scenario, usual: Scenario) -> TensorDict:
        """The report of a descent; the weights stay as they were if the twin diverges where it begins.

        The twin must be sound in the usual episodes alone: what has just flown may fail in further ones.
        """
        policy = self.planner.policy
        before = copy.deepcopy(policy.state_dict())
        try:
            return planned(self.planner.plan(episodes))
        except FloatingPointError:
            self.belief.require_sound_twin(usual)
            policy.load_state_dict(before)
            self.planner.restart()
            return metrics("no plan: the twin diverges", plan_accepted=0.0)

    def _several(self, episode: int, plan: Plan) -> bool:
        """Whether to plan from other weights, too."""
        if not self.count or not isinstance(self.planner, WholeEpisodes):
            return False
        report = plan.report  # without a gradient where the twin has diverged
        stalled = "policy_gradient" not in report or self.planner.stalled(*(report[key].item() for key in DESCENT))
        self._stalled = self._stalled + 1 if stalled else 0
        return episode in SEVERAL or self._stalled.bit_count() == 1

    @torch.no_grad()
    def _random(self, episode: int, planned_on: Scenario) -> Weights:
        """The weights of the random policy that costs least on the twin; what is not trained is not drawn."""
        policy, source = self.planner.policy, self.virtual.generator
        seed = (source.initial_seed() + STRIDE * episode) % SEEDS
        generator = torch.Generator(device=source.device).manual_seed(seed)
        kept = copy.deepcopy(policy.state_dict())
        named = policy.named_parameters(remove_duplicate=False)  # a shared weight has several names
        trained = {name for name, weight in named if weight.requires_grad}
        best: tuple[float, Weights] = math.inf, kept
        for _ in range(self.count):
            drawn = self.make_policy(generator).state_dict()
            weights = {name: drawn[name] if name in trained else value for name, value in kept.items()}
            policy.load_state_dict(weights)
            cost = self.virtual.cost(policy, planned_on)
            if cost < best[0]:
                best = cost, weights
        policy.load_state_dict(kept)
        return best[1]

    def get_extra_state(self) -> dict[str, Any]:
        """The state of the planner, and for how many plans gradients have exploded."""
        return super().get_extra_state() | {"stalled": self._stalled}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        super().set_extra_state(state)
        self._stalled = state["stalled"]


def planned(plan: Descended) -> TensorDict:
    """The report of a plan that is kept."""
    return metrics(J_a_plan_before=plan.start, J_a_plan=plan.best, policy_gradient=plan.gradient, plan_accepted=1.0)
