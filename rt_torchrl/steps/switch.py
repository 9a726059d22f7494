r"""Step 6: a referee says which policy acts next, and whether the idle one becomes a clone of the live one.

A clone takes the weights, or imitates where it cannot. The imitation is behaviour cloning, as is that of a controller
with which a training begins. It compares actions, as shares of their ranges, on observations from the real system and
from the twin:

.. math:: \min_w \mathbb E_e\,\Big\|\frac{\pi(e; w) - \pi_{live}(e)}{a_{hi} - a_{lo}}\Big\|^2

A second round adds observations of virtual episodes that the pupil itself flies, so that it also learns what to do
where its own errors lead (DAgger, Ross et al. 2011).
"""

import copy
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from rt_torchrl.control.predictive_control import affordable
from rt_torchrl.optimisers.descent import Descent, DescentConfig
from rt_torchrl.plants.signal import bounds
from rt_torchrl.steps.belief import Belief, equal
from rt_torchrl.steps.config import ROLES, RefereeConfig, Role
from rt_torchrl.steps.learn import Learner
from rt_torchrl.steps.plan import Planner
from rt_torchrl.steps.report import Step, merged, metrics, record_of, same_architecture
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback, commands_along
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory

Event = Literal["keep", "swap", "clone"]
STALL = 0.5
"""Relative weight change T_w below which the idle policy has stalled; P_w decides how soon that makes it a clone."""
ITERATIONS = 200
"""Gradients of the imitation loss in each round (L-BFGS on all observations at once)."""
RIDGE = 1e-9
"""Price of the sum of squares of weights. None imitate a jump: without a price they grow until gradients vanish."""
SAMPLES = 5000
"""Greatest number of observations from each source; a source with more is thinned evenly."""
BLOWN_UP = 1e3
"""Observation, which is of order one in a sound flight, beyond which a twin has blown up."""
TWICE = 2.0
"""Cost over the controller's, extreme episodes included, beyond which an imitation learns from these, too."""
Result = TypeVar("Result")


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


class DecisionTree:
    """The paper's decision tree (figure decisionTree), which also decides by expected costs.

    The roles swap when the live policy has cost more than the idle one for more than P_π episodes in a row, at once
    with the rule ``expected_cost``; two policies of equal cost never change roles. Otherwise the idle policy becomes a
    clone when it has stalled for more than P_w episodes in a row. Each counter restarts when its condition fails; the
    second counter also restarts while the live policy is worse.

    Note: the paper prints J_live/J_idle < T_J for "the live policy performs worse". Here the condition is >, because a
    smaller cost is better; T_J is 1, as in all test cases of the paper.

    Args:
        config: parameters of step 6.
        live: role that starts live; the paper starts with the model-free policy.
    """

    def __init__(self, config: RefereeConfig, live: Role = "model_free"):
        self.config = config
        self.live: Role = live
        self.worse_count = 0  # C_π
        self.stall_count = 0  # C_w

    def decide(self, evidence: Evidence) -> Event:
        config = self.config
        if evidence.live_cost > evidence.idle_cost:
            self.worse_count, self.stall_count = self.worse_count + 1, 0
            if self.worse_count <= (config.patience if config.rule == "decision_tree" else 0):
                return "keep"
            self.worse_count, self.live = 0, other_than(self.live)
            return "swap"
        self.worse_count = 0
        self.stall_count = self.stall_count + 1 if evidence.idle_weight_change < STALL else 0
        if self.stall_count <= config.clone_patience:
            return "keep"
        self.stall_count = 0
        return "clone"

    def state_dict(self) -> dict[str, Any]:
        """The live role and all counters."""
        return {name: value for name, value in vars(self).items() if name != "config"}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        vars(self).update(state)


MakeReferee = Callable[[RefereeConfig, Role], Referee]
"""Function of a configuration and the role that starts live that makes the referee of step 6."""


class Imitation:
    """Lets policies imitate each other and controllers.

    Args:
        belief: what policies cost, by which clones are judged, and the virtual episodes.
        count: number of virtual episodes that are drawn at a time.
    """

    def __init__(self, belief: Belief, count: int):
        self.belief, self.virtual, self.count = belief, belief.virtual, count

    def clone(
        self,
        live: nn.Module,
        idle: nn.Module,
        *,
        seen: Callable[[], Float[Tensor, "n n_o"]],
        record: Trajectory,
        judged_on: Scenario,
    ) -> TensorDict:
        """Make ``idle`` a clone of ``live``; it keeps its weights if the clone is expected to cost more than it does.

        Args:
            live: the policy that is cloned; it is not changed.
            idle: the policy that becomes the clone.
            seen: function that gives observations of the real system; a copy of weights does not call it.
            record: the real episode that ``live`` has just flown, from which a clone of state feedback learns; without
                intervals if another policy flew.
            judged_on: virtual episodes on which the clone is judged.

        Returns:
            A report, which is empty after a copy of weights. After an imitation it holds ``distillation_error`` and
            ``distillation_cost_ratio``; if the clone is refused, the event is ``keep``, and ``reason`` says why. State
            feedback has no weights that could imitate, so that a clone of it is refused.
        """
        if isinstance(idle, StateFeedback):
            return metrics(f"no clone: {type(idle).__name__} plans its actions and imitates nobody", event="keep")
        if same_architecture(live, idle):
            idle.load_state_dict(live.state_dict())
            return metrics()
        before, replaced = copy.deepcopy(idle.state_dict()), self.belief.judge(idle, judged_on)
        source = record if isinstance(live, StateFeedback) else seen()
        error = self.imitate(live, idle, seen=source, draw=lambda: self.virtual.draw(self.count))
        clone, cost = self.belief.judge(idle, judged_on), self.virtual.cost(live, judged_on)
        entries = {"distillation_error": error, "distillation_cost_ratio": clone.on_twin / cost}
        if clone <= replaced:
            return metrics(**entries)
        idle.load_state_dict(before)
        costs = f"it is expected to cost {clone.expected:.4g}, and what it replaces {replaced.expected:.4g}"
        return metrics(f"clone refused: {costs}", **entries, event="keep")

    def begin(
        self, teacher: nn.Module | None, policies: Mapping[Role, nn.Module], records: Trajectory, cost: float
    ) -> TensorDict:
        """Make the policies imitate a controller; one that would fare worse on the twin than before stays as it was.

        Where a twin is trained, they also learn from virtual episodes, and are judged in them.

        Args:
            teacher: the controller, a policy or :class:`StateFeedback`; None if only the records show its actions.
            policies: the policies by role; state feedback among them is left alone.
            records: real episodes that the controller has flown.
            cost: mean J_a of these.

        Returns:
            ``start_error_`` of each role, the RMS difference of the actions as a share of their ranges, and on the twin
            ``start_cost_ratio_``, J_a of the policy over the controller's.
        """
        pupils = {role: policy for role, policy in policies.items() if not isinstance(policy, StateFeedback)}
        starts = {role: copy.deepcopy(policy) for role, policy in pupils.items()}
        judged_on = self.virtual.draw(affordable(teacher, self.count)) if self.virtual.processes else None
        report = metrics()
        for role, policy in pupils.items():
            first = next(other for other, start in starts.items() if clones(start, starts[role]))
            if first != role:
                policy.load_state_dict(pupils[first].state_dict())
            elif judged_on is None:
                report.update(metrics(**{f"start_error_{role}": self._match(policy, [self._of_record(records)])}))
            else:
                report = merged(report, self._begun(teacher, role, policy, records, judged_on, cost))
        return report

    def _begun(
        self,
        teacher: nn.Module | None,
        role: Role,
        policy: nn.Module,
        records: Trajectory,
        judged_on: Scenario,
        teacher_cost: float,
    ) -> TensorDict:
        before, start = copy.deepcopy(policy.state_dict()), self.virtual.judge(policy, judged_on)
        if teacher is None:
            error = self._match(policy, [self._of_record(records)])
        else:
            draw = functools.partial(self.virtual.draw, len(judged_on.initial_state))
            error = self.imitate(teacher, policy, seen=records, draw=draw)
            model, teacher_cost = self.virtual.judge(teacher, judged_on)
            if len(self.virtual.extremes) and self.virtual.judge(policy, judged_on)[0] > TWICE * abs(model):
                policy.load_state_dict(before)
                error = self.imitate(teacher, policy, seen=records, draw=lambda: self.virtual.with_extremes(draw()))
        cost = self.virtual.judge(policy, judged_on)
        entries = {f"start_error_{role}": error, f"start_cost_ratio_{role}": min(cost, start)[1] / teacher_cost}
        if cost <= start:
            return metrics(**entries)
        policy.load_state_dict(before)
        return metrics(
            f"{role} does not imitate the controller: it would cost {cost[0]:.4g}, not {start[0]:.4g}", **entries
        )

    def imitate(
        self,
        teacher: nn.Module,
        pupil: nn.Module,
        *,
        seen: Float[Tensor, "n n_o"] | Trajectory,
        draw: Callable[[], Scenario],
    ) -> float:
        """Train the pupil in place.

        Args:
            teacher: the teacher, which is not changed.
            pupil: the pupil, which starts from its present weights.
            seen: observations of the real system, or episodes that the teacher has flown there. State feedback needs
                the episodes, because its actions are no function of the observation; they are taken as recorded.
            draw: function that draws new initial states and disturbances of virtual episodes at each call.

        Returns:
            RMS difference between the two policies' actions on all observations, as a share of the actions' ranges.
        """
        pairs = [self._of_record(seen) if isinstance(seen, Trajectory) else self._asked(teacher, seen)]
        pairs.append(self._flown(teacher, teacher, draw()))
        self._match(pupil, pairs)
        pairs.append(self._flown(teacher, pupil, draw()))
        return self._match(pupil, pairs)

    def _match(self, pupil: nn.Module, pairs: list[tuple[Tensor, Tensor]]) -> float:
        """Fit the pupil's actions in place by the mean square of differences; the RMS, as a share of the ranges."""
        observations, actions = (torch.cat(part) for part in zip(*pairs, strict=True))
        low, high = bounds(self.virtual.twin.plant.actions, device=observations.device)
        target = (actions - low) / (high - low)

        weights = [weight for weight in pupil.parameters() if weight.requires_grad]

        def loss() -> Tensor:
            shares = (pupil(observations) - low) / (high - low)
            size = torch.stack([weight.square().sum() for weight in weights]).sum()
            return nn.functional.mse_loss(shares, target) + RIDGE * size

        return Descent(pupil, DescentConfig(optimiser="lbfgs", rate=1.0)).run(loss, ITERATIONS).best ** 0.5

    @torch.no_grad()
    def _flown(self, teacher: nn.Module, policy: nn.Module, episodes: Scenario) -> tuple[Tensor, Tensor]:
        """Observations of virtual episodes that a policy flies, and what the teacher does there, where both are sound.

        A twin that lacks dynamics of the real system may blow up in a flight, and says nothing of what comes after.
        Nothing acts after an early end.
        """
        plant, like = self.virtual.twin.plant, episodes.initial_state
        try:
            flown = self.virtual.twin.control(policy, *episodes)
            if isinstance(teacher, StateFeedback):
                along = flown.actions if policy is teacher else commands_along(teacher, flown, plant.dt)
                observations, actions = self._of_record(flown._replace(actions=along))
            else:
                observations, actions = self._asked(teacher, self._observed(flown))
        except DivergenceError:
            return like.new_empty(0, len(plant.observations)), like.new_empty(0, len(plant.actions))
        sound = (observations.abs() <= BLOWN_UP).all(-1) & actions.isfinite().all(-1)
        sound &= ~self._thinned(plant.ended(flown.states[:, :-1]).flatten())
        return observations[sound], actions[sound]

    @torch.no_grad()
    def _asked(self, teacher: nn.Module, observations: Float[Tensor, "n n_o"]) -> tuple[Tensor, Tensor]:
        """Observations of a source, thinned, and the teacher's actions."""
        thinned = self._thinned(observations)
        return thinned, teacher(thinned)

    def _of_record(self, flown: Trajectory) -> tuple[Tensor, Tensor]:
        """Observations and actions of a record of one episode or several, thinned."""
        return self._thinned(self._observed(flown)), self._thinned(flown.actions.reshape(-1, flown.actions.shape[-1]))

    def _observed(self, flown: Trajectory) -> Float[Tensor, "n n_o"]:
        plant, exogenous = self.virtual.twin.plant, flown.exogenous
        clock = plant.dt * torch.arange(exogenous.shape[-2], dtype=torch.float64, device=exogenous.device)
        t = (flown.start.unsqueeze(-1) if isinstance(flown.start, Tensor) else flown.start) + clock
        seen = plant.observe(t, flown.states[..., :-1, :], exogenous)
        return seen.reshape(-1, seen.shape[-1])

    def _thinned(self, values: Tensor) -> Tensor:
        return values[:: max(1, -(-len(values) // SAMPLES))]  # of none, none is left


def of_each_role(policies: Mapping[Role, nn.Module], flown: Callable[[nn.Module], Result]) -> dict[Role, Result]:
    """What ``flown`` returns for each policy; it is called once if the two are clones of each other.

    Args:
        policies: both policies, by role.
        flown: function of a policy's weights alone, such as its costs over given episodes.
    """
    first, second = policies
    results = {first: flown(policies[first])}
    return results | {second: results[first] if clones(*policies.values()) else flown(policies[second])}


def clones(first: nn.Module, second: nn.Module) -> bool:
    """Whether two policies are the same function with the same weights."""
    return same_architecture(first, second) and equal(first.state_dict(), second.state_dict())


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
                if belief.corrects:
                    clone = belief.judge(belief.policies[idle], judged_on)
                    cloned.update(metrics(**{f"expected/{idle}": clone.expected}))
            report = merged(report, cloned)
        return merged(episode, report)
