"""Step 5: the planner improves π_mb on the twin from several starts; what is expected to cost least stays."""

import contextlib
import copy
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from rt_torchrl.control.predictive_control import PredictiveConfig, PredictiveControl
from rt_torchrl.optimisers.descent import Descended, Descent, DescentConfig, stuck
from rt_torchrl.optimisers.limited_mean import limited_mean
from rt_torchrl.options import check_options, require_widths
from rt_torchrl.steps.belief import Belief, Judged
from rt_torchrl.steps.constraints import Constraints, ConstraintsConfig
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.architecture import same_architecture
from rt_torchrl.twinning.findings import findings, merged

Weights = dict[str, Tensor]
STRIDE = 1_000_003
"""Difference of the seeds of the random policies of two episodes."""
SEEDS = 2**63
"""Number of seeds of a generator."""


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
            Mean J_a on ``episodes`` before and after, the norm of the first gradient, and the number of iterations.

        Raises:
            DivergenceError: if the twin diverges with the present policy.
        """

    def refuse(self) -> None:
        """React to a plan that was worse on other episodes; the policy has its earlier weights again."""

    def restart(self) -> None:
        """Forget everything that belongs to the policy's earlier weights, because the policy's weights have jumped."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next plan depends on, except the policy's weights: tensors in plain containers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of a planner with the same configuration."""


@dataclass(frozen=True, kw_only=True)
class ShortHorizonConfig:
    """Parameters of the planning over short windows.

    Args:
        window: number of control intervals in a window; 0 plans over whole episodes instead, as in the paper.
        discount: discount factor γ per control interval.
        mixing: weight λ of the rest of the window in the critic's targets; the critic itself has the weight 1 − λ.
        critic_iterations: gradients of the critic for each window.
        critic_hidden: widths of the critic's hidden layers.
        target_rate: share of the distance to the critic that the target critic moves after each window.
        policy_rate: learning rate of the policy (Adam).
        critic_rate: learning rate of the critic (Adam).
    """

    window: int = 0
    discount: float = 0.98
    mixing: float = 0.95
    critic_iterations: int = 8
    critic_hidden: tuple[int, ...] = (64, 64)
    target_rate: float = 0.2
    policy_rate: float = 5e-3
    critic_rate: float = 2e-3

    def __post_init__(self) -> None:
        check_options(self)
        require_widths("critic_hidden", self.critic_hidden)
        for argument, least in (("window", 0), ("critic_iterations", 1)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must be at least {least}.")
        if not 0.0 <= self.discount < 1.0:
            raise ValueError(f"discount={self.discount} of the short horizon must lie in [0, 1).")
        for argument in ("mixing", "target_rate"):
            if not 0.0 < getattr(self, argument) <= 1.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must lie in (0, 1].")
        for argument in ("policy_rate", "critic_rate"):
            if not getattr(self, argument) > 0.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must be positive.")


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Parameters of step 5.

    Args:
        method: method of the model-based policy: whole_episodes descends the cost of whole virtual episodes,
            short_horizon that of short windows plus a learned tail cost, and receding_horizon is model predictive
            control, which has no weights of its own and plans while it acts. By default short_horizon if its window is
            positive, and else whole_episodes.
        iterations: number n_mb of gradients per episode or, with a short horizon, of sweeps through the virtual
            episodes.
        realisations: number N_z of virtual episodes that a plan is made on; None takes ``realisations`` of the
            algorithm. Twenty virtual episodes take about as long as one, and where the initial states differ much, a
            plan made on one of them says little about the others.
        starts: number of random policies, the best of which is a start of plans over whole episodes
            (:class:`MultiStart`); 0 plans from the present weights alone, as in the paper.
        episode_gradient_limit: limit κ of the gradient of each virtual episode, see :func:`limited_mean`, in a second
            descent over whole episodes where the first one gains nothing beside a mean gradient that is longer;
            infinite for none, as in the paper.
        experience: number of latest real episodes whose exogenous inputs steps 5 and 6 draw from; 1 as in the paper.
        extremes: number of random initial states among which the extremes of each state are found, from which a plan
            and an imitation must not fail; 0 for none. Twenty virtual episodes do not show what a policy does in one
            of hundreds.
        constraints: bounds on states that plans over whole episodes keep.
        descent: parameters of the policy's descent over whole episodes.
        short_horizon: parameters of planning over short windows, for tasks where gradients of whole episodes are of no
            use.
        receding_horizon: parameters of model predictive control.
    """

    method: Literal["whole_episodes", "short_horizon", "receding_horizon"] | None = None
    iterations: int = 10
    realisations: int | None = None
    starts: int = 32
    episode_gradient_limit: float = 10.0
    experience: int = 100
    extremes: int = 1000
    constraints: ConstraintsConfig = field(default_factory=ConstraintsConfig)
    descent: DescentConfig = field(default_factory=DescentConfig)
    short_horizon: ShortHorizonConfig = field(default_factory=ShortHorizonConfig)
    receding_horizon: PredictiveConfig = field(default_factory=PredictiveConfig)

    @property
    def whole(self) -> bool:
        """Whether plans descend over whole episodes."""
        return not self.short_horizon.window and self.method != "receding_horizon"

    def __post_init__(self) -> None:
        check_options(self, infinite=("episode_gradient_limit",))
        if self.method is not None and (self.method == "short_horizon") != (self.short_horizon.window > 0):
            raise ValueError(
                f"method={self.method!r} of the planning does not go with short_horizon.window="
                f"{self.short_horizon.window}; a positive window belongs to short_horizon alone."
            )
        if self.constraints.states and not self.whole:
            raise ValueError(
                f"constraints.states of {', '.join(self.constraints.states)} need plans over whole episodes: leave "
                "planner.method and short_horizon.window as they are, or leave the constraints out."
            )
        for argument, least in (("iterations", 0), ("starts", 0), ("extremes", 0), ("experience", 1)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} of the planning must be at least {least}.")
        if self.realisations is not None and self.realisations < 1:
            raise ValueError(f"realisations={self.realisations} of the planning (N_z) must be at least 1.")
        if not self.episode_gradient_limit >= 1.0:
            raise ValueError(
                f"episode_gradient_limit={self.episode_gradient_limit} of the planning must be at least 1; infinite is "
                "no limit."
            )


class WholeEpisodes:
    r"""Descends :math:`J_a = \mathbb E\frac1{T_o}\int L_a\,dt` over the weights of π_mb, on the twin (paper, eq. J_a).

    Args:
        twin: twin with the best closure so far, w_p*.
        policy: policy π_mb, updated in place.
        config: parameters of step 5.

    The attribute ``constraints`` prices what leaves the bounds of ``config.constraints``, in the plans and where the
    algorithm compares policies on the twin. A plan leaves its multipliers as they are.
    """

    def __init__(self, twin: DigitalTwin, policy: nn.Module, config: PlannerConfig):
        self.twin, self.policy, self.config = twin, policy, config
        self.descent = Descent(policy, config.descent)
        self.constraints = Constraints(twin.plant, config.constraints)

    def plan(self, episodes: Scenario) -> Descended:
        """Take n_mb gradients, and as many limited ones where they gain nothing; the policy keeps the best weights."""
        limit = self.config.episode_gradient_limit
        found = self.descent.run(lambda: self._cost(episodes, math.inf), self.config.iterations)
        if self._stalled(found.start, found.best, found.gradient):
            again = self.descent.run(lambda: self._cost(episodes, limit), self.config.iterations)
            found = found._replace(best=again.best, iterations=found.iterations + again.iterations)
        return found

    def stalled(self, plan: TensorDict) -> bool:
        """Whether the plan of a report gained nothing, or was none, although its first gradient exceeds the limit."""
        if math.isinf(self.config.episode_gradient_limit):
            return False
        if "policy_gradient" not in plan:
            return True
        return self._stalled(*(plan[key].item() for key in ("J_a_plan_before", "J_a_plan", "policy_gradient")))

    def _stalled(self, before: float, after: float, gradient: float) -> bool:
        weights = [w.detach() for w in self.policy.parameters() if w.requires_grad]
        return stuck(before, after, gradient, weights, self.config.episode_gradient_limit)

    def _cost(self, episodes: Scenario, limit: float) -> Tensor:
        costs = self.constraints.costs(self.twin, self.policy, episodes)
        return limited_mean(costs, self.policy.parameters(), limit)

    def refuse(self) -> None:
        """Forget the state of the optimiser, because it led to the plan that was refused."""
        self.restart()

    def restart(self) -> None:
        """Forget the state of the optimiser."""
        self.descent.restart()

    def state_dict(self) -> dict[str, Any]:
        priced = {"constraints": self.constraints.state_dict()} if self.constraints else {}
        return self.descent.state_dict() | priced

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if self.constraints:
            self.constraints.load_state_dict(state["constraints"])
        self.descent.load_state_dict({name: part for name, part in state.items() if name != "constraints"})


class RecedingHorizonPlanner:
    """Fits the forecast of model predictive control to the inputs that have been met.

    The controller plans on the twin's closure itself, and so follows step 4 at once.

    Args:
        twin: twin on which the controller plans.
        policy: the controller, which acts in the place of π_mb.
        config: parameters of step 5.

    Raises:
        ValueError: if the controller plans on another closure than the twin's.
    """

    policy: nn.Module

    def __init__(self, twin: DigitalTwin, policy: PredictiveControl, config: PlannerConfig):
        if policy.closure is not twin.closure:
            raise ValueError("the controller plans on another closure than the twin's; build it with twin.closure.")
        self.twin, self.policy, self.config, self._learn = twin, policy, config, policy.learn

    def plan(self, episodes: Scenario) -> Descended:
        """Fit the forecast to the inputs of the episodes; the cost before is the cost after, without a gradient."""
        self._learn(episodes.exogenous)
        count = self.config.receding_horizon.virtual_episodes
        cost = self.twin.cost(self.policy, episodes.initial_state[:count], episodes.exogenous[:count]).item()
        return Descended(cost, cost, 0.0, 0)

    def refuse(self) -> None:
        """Do nothing: there are no weights to go back to."""

    def restart(self) -> None:
        """Do nothing: the closure has jumped back, and the controller plans on it as it is."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing: the forecast belongs to the controller."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Do nothing."""


def make_planner(twin: DigitalTwin, policy: nn.Module, config: PlannerConfig, *, generator: torch.Generator) -> Planner:
    """The planner of a configuration; see :class:`PlannerConfig` for the methods.

    Args:
        twin: twin on which the policy is planned.
        policy: policy π_mb, updated in place.
        config: parameters of step 5.
        generator: source of the initial weights of a short horizon's critic.

    Raises:
        ValueError: if the method is receding_horizon and the policy is not :class:`PredictiveControl`, or the other way
            round.
    """
    from rt_torchrl.steps.short_horizon import ShortHorizon  # which needs the parameters above

    if isinstance(policy, PredictiveControl):
        if config.method == "receding_horizon":
            return RecedingHorizonPlanner(twin, policy, config)
    elif config.method != "receding_horizon":
        if config.short_horizon.window:
            return ShortHorizon(twin, policy, config, generator=generator)
        return WholeEpisodes(twin, policy, config)
    raise ValueError(
        f"method={config.method!r} of the planning does not go with a policy of class {type(policy).__name__}: "
        "receding_horizon needs model_based=PredictiveControl(twin.plant, twin.closure, ...), and it alone."
    )


class Plan(NamedTuple):
    """Weights that a descent ended at, what they cost on other virtual episodes, and the report of the descent."""

    weights: Weights
    cost: Judged
    report: TensorDict


class MultiStart:
    """Plans from several starts on some virtual episodes, and judges the plans on others; the best one stays.

    A descent begins with the present weights. It begins with others, too, in the first episode, the second, the fourth
    and so on, and where gradients explode in the first plan that gains nothing or is refused, the second, the fourth
    and so on: with those before the imitation of a controller, with the best of some random policies, and with those
    that have flown and are expected to cost least. Where the twin is wrong, what has flown stays as it is if it is
    expected to cost less than every plan.

    Note: the paper keeps every plan. Here a plan made on N_z winds is compared with the previous policy on N other
    winds, because the best policy for a few winds can lie just beyond a cliff of another wind. State feedback plans
    while it acts, so that there is nothing to compare.

    Random policies have random numbers of their own, so that a training whose plan they do not improve is the same
    without them.

    Args:
        planner: planner of step 5.
        belief: what policies cost on the real system, and the virtual episodes.
        config: parameters of step 5.
        make_policy: function that draws a random policy of the same architecture; None for that of the plant, if its
            policies have the same architecture, and else for no random policies.

    Raises:
        ValueError: if it draws policies of another architecture.
    """

    def __init__(
        self,
        planner: Planner,
        belief: Belief,
        config: PlannerConfig,
        make_policy: Callable[[torch.Generator], nn.Module] | None = None,
    ):
        self.planner, self.belief, self.virtual = planner, belief, belief.virtual
        several = config.whole and not isinstance(planner.policy, StateFeedback)
        self.count = config.starts if several else 0
        self.make_policy = make_policy or self.virtual.twin.plant.make_policy
        self._first: Weights | None = None
        self._stalled = 0
        drawn = self.make_policy(self._generator(0)) if self.count else planner.policy
        self.alike = same_architecture(drawn, planner.policy)
        if make_policy is not None and not self.alike:
            raise ValueError(
                f"make_policy draws a {type(drawn).__name__}, and model_based is another "
                f"{type(planner.policy).__name__}; let it draw random policies like that one, or use starts=0."
            )

    def remember(self) -> None:
        """Plan from the present weights, too, whenever plans have several starts; state feedback has none."""
        if self.count:
            self._first = copy.deepcopy(self.planner.policy.state_dict())

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
        if isinstance(policy, StateFeedback):
            return self._descended(planned_on) or findings(plan_accepted=0.0)
        present = copy.deepcopy(policy.state_dict())
        stays = self.belief.judge(policy, judged_on)
        if not math.isfinite(stays.price):
            self.belief.require_sound_twin(judged_on)
        best = self._from_the_present(present, stays, planned_on, judged_on)
        several = self._several(episode, best)
        flown = self.belief.best_flown(policy, judged_on) if several or self._refuted else None
        if several:
            best = self._best(best, self._others(episode, planned_on, flown), planned_on, judged_on)
        if flown is not None and self._refuted and flown[1] < best.cost:
            best = Plan(*flown, findings(plan_accepted=0.0, recalled=1.0))
            policy.load_state_dict(best.weights)
            self.planner.restart()
        return merged(best.report, self._raised(planned_on))

    @property
    def _refuted(self) -> bool:
        """Whether a policy that has flown may be better than all that the twin plans."""
        return self.count > 0 and self.belief.corrects and self.belief.contradicted

    def _best(self, best: Plan, others: Iterable[Weights], planned_on: Scenario, judged_on: Scenario) -> Plan:
        """The best of a plan and of those from other weights; the policy gets its weights."""
        after, start = copy.deepcopy(self.planner.state_dict()), 0
        for number, weights in enumerate(others, start=1):
            plan = self._from_others(weights, planned_on, judged_on)
            if plan is not None and plan.cost < best.cost:
                best, start = plan, number
        self.planner.policy.load_state_dict(best.weights)
        if start:
            self.planner.restart()
        else:
            self.planner.load_state_dict(after)
        return best._replace(report=best.report.update(findings(start=float(start))))

    def _from_the_present(self, present: Weights, stays: Judged, planned_on: Scenario, judged_on: Scenario) -> Plan:
        """A plan from the present weights, or these; one that fails from extreme starts is made again on these, too."""
        policy, report = self.planner.policy, findings()
        for episodes in (planned_on, self.virtual.with_extremes(planned_on)):
            found = self._descended(episodes, usual=planned_on)
            if found is None:
                return Plan(present, stays, findings("no plan: the twin diverges", plan_accepted=0.0))
            report = found
            cost = self.belief.judge(policy, judged_on)
            if cost <= stays and math.isfinite(cost.price):
                return Plan(copy.deepcopy(policy.state_dict()), cost, report)
            policy.load_state_dict(present)
            self.planner.refuse()
            if not len(self.virtual.extremes) or cost.price > stays.price:
                break
        return Plan(present, stays, report.update(findings(plan_accepted=0.0, J_a_plan=report["J_a_plan_before"])))

    def _from_others(self, weights: Weights, planned_on: Scenario, judged_on: Scenario) -> Plan | None:
        """A plan that begins with other weights; None if the twin diverges under these."""
        policy = self.planner.policy
        policy.load_state_dict(weights)
        self.planner.restart()
        try:
            report = planned(self.planner.plan(planned_on))
        except FloatingPointError:
            return None  # the twin is sound with the present policy, so that these weights are to blame
        return Plan(copy.deepcopy(policy.state_dict()), self.belief.judge(policy, judged_on), report)

    def _descended(self, episodes: Scenario, usual: Scenario | None = None) -> TensorDict | None:
        """The report of a descent; None, and the weights as they were, if the twin diverges where it begins.

        The twin must be sound in the usual episodes alone: what has just flown may diverge from extreme starts.
        """
        policy = self.planner.policy
        before = copy.deepcopy(policy.state_dict())
        try:
            return planned(self.planner.plan(episodes))
        except FloatingPointError:
            self.belief.require_sound_twin(episodes if usual is None else usual)
            policy.load_state_dict(before)
            self.planner.restart()
            return None

    def _several(self, episode: int, plan: Plan) -> bool:
        """Whether to plan from other weights, too."""
        if not self.count or not isinstance(self.planner, WholeEpisodes):
            return False
        self._stalled = self._stalled + 1 if self.planner.stalled(plan.report) else 0
        return episode.bit_count() == 1 or self._stalled.bit_count() == 1

    def _others(self, episode: int, planned_on: Scenario, flown: tuple[Weights, Judged] | None) -> Iterator[Weights]:
        """Other weights to begin with."""
        if self._first is not None:
            yield self._first
        if self.alike:
            yield self._random(episode, planned_on)
        if flown is not None:
            yield flown[0]

    @torch.no_grad()
    def _random(self, episode: int, planned_on: Scenario) -> Weights:
        """The weights of the random policy that costs least on the twin; what is not trained is not drawn."""
        policy, generator = self.planner.policy, self._generator(episode)
        kept = copy.deepcopy(policy.state_dict())
        trained = {name for name, weight in policy.named_parameters() if weight.requires_grad}
        best: tuple[float, Weights] = math.inf, kept
        for _ in range(self.count):
            drawn = self.make_policy(generator).state_dict()
            weights = {name: drawn[name] if name in trained else value for name, value in kept.items()}
            policy.load_state_dict(weights)
            cost = self.virtual.price(policy, planned_on)
            if cost < best[0]:
                best = cost, weights
        policy.load_state_dict(kept)
        return best[1]

    def _generator(self, episode: int) -> torch.Generator:
        own = self.virtual.generator
        return torch.Generator(device=own.device).manual_seed((own.initial_seed() + STRIDE * episode) % SEEDS)

    @torch.no_grad()
    def _raised(self, episodes: Scenario) -> TensorDict:
        """Raise the multipliers by the excess of the policy that stays, once all plans of this episode are judged.

        Plans and what they would replace are so compared at the same price. What a refused plan exceeds is no matter.
        """
        constraints = self.virtual.constraints
        if not constraints:
            return findings()
        with contextlib.suppress(FloatingPointError):  # of a refused policy that diverges
            constraints.update(self.virtual.twin.control(self.planner.policy, *episodes))
        return findings(**constraints.report())

    def state_dict(self) -> dict[str, Any]:
        """The weights that later plans begin with, and for how many plans gradients have exploded."""
        return {"first": self._first, "stalled": self._stalled}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of another one with the same planner."""
        self._first, self._stalled = state["first"], state["stalled"]


def planned(found: Descended) -> TensorDict:
    """The report of a plan that is kept."""
    return findings(J_a_plan_before=found.start, J_a_plan=found.best, policy_gradient=found.gradient, plan_accepted=1.0)
