r"""Reinforcement Twinning: the six steps of the paper's algorithm, one method each.

There are two policies of the same observation, π_mf (model-free) and π_mb (model-based). One is live: it acts on the
real system. The other is idle: it learns at the same time and can take over.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.control.predictive_control import PredictiveControl
from rt_torchrl.interruption import safe_point
from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import ROLES, Role
from rt_torchrl.steps.imitation import Imitation
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.learn import ActorCritic, Learner
from rt_torchrl.steps.plan import MultiStart, Planner, make_planner
from rt_torchrl.steps.switch import Evidence, Referee, make_referee
from rt_torchrl.systems.collectors import collector_of
from rt_torchrl.systems.exploration import LivePolicy
from rt_torchrl.systems.operation.operation import Operation, system_of
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory, batch_of
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.clearance import Clearance
from rt_torchrl.twinning.config import TwinningConfig
from rt_torchrl.twinning.earlier_closure import EarlierClosure
from rt_torchrl.twinning.findings import EpisodeReport, findings, merged, weight_change, weight_vector
from rt_torchrl.twinning.flight import Flight, RealFlights
from rt_torchrl.twinning.hypotheses.choice import make_assimilation
from rt_torchrl.twinning.learning import Learning
from rt_torchrl.twinning.operating import Operating
from rt_torchrl.twinning.saved_state import load_parts, on_device
from rt_torchrl.twinning.short_term_memory import ShortTermMemory
from rt_torchrl.twinning.starts import Start, first_live


class ReinforcementTwinning:
    """The algorithm; call :meth:`episode` once per real episode.

    Args:
        env: the real system, of batch size 1: :class:`PlantEnv`, :class:`RealSystem`, or an :class:`Operation` of one.
        twin: the digital twin, whose closure is trained in place.
        model_free: policy π_mf, trained in place; it starts live, except in the arm ``model_based`` or with ``first``.
        model_based: policy π_mb, trained in place, or :class:`PredictiveControl` on the twin's closure.
        config: hyper-parameters of the six steps.
        generator: source of all random numbers that the real system does not draw itself.
        learner: learner of step 2, which trains ``model_free``; by default that of ``config.learner``.
        planner: planner of step 5, which trains ``model_based``; by default that of ``config.planner``.
        referee: referee of step 6; by default that of ``config.referee``.
        first: what is known beforehand, such as :class:`FirstController`; None begins with the policies as they are.
        make_policy: function that draws a random policy like ``model_based``; by default that of the plant.

    Raises:
        ValueError: if the real system's batch size is not 1, or learner or planner train other policies.
    """

    def __init__(
        self,
        env: EnvBase | Operation,
        twin: DigitalTwin,
        *,
        model_free: nn.Module,
        model_based: nn.Module,
        config: TwinningConfig,
        generator: torch.Generator,
        learner: Learner | None = None,
        planner: Planner | None = None,
        referee: Referee | None = None,
        first: Start | None = None,
        make_policy: Callable[[torch.Generator], nn.Module] | None = None,
    ):
        self.env, self.twin, self.config, self.generator, self.first = env, twin, config, generator, first
        self.policies: dict[Role, nn.Module] = {"model_free": model_free, "model_based": model_based}
        self.learner = learner or ActorCritic(twin.plant, model_free, config.learner, generator=generator)
        self.planner = planner or make_planner(twin, model_based, config.planner, generator=generator)
        self.referee = referee or make_referee(config.referee, first_live(config.arm, first))
        for role, part in (("model_free", self.learner), ("model_based", self.planner)):
            if part.policy is not self.policies[role]:
                raise ValueError(f"{type(part).__name__} trains another policy than {role}; build it with that module.")
        share_critic(self.learner, model_based)
        self.fed_back = isinstance(model_based, StateFeedback)  # it plans on the twin alone while it acts
        self.assimilation = make_assimilation(twin, config.assimilation, config.hypotheses, always=self.fed_back)
        self.short_term = ShortTermMemory(config.records)
        self.virtual = VirtualEpisodes(
            twin,
            config.exogenous,
            config.experience,
            constraints=getattr(self.planner, "constraints", None),
            extremes=0 if self.fed_back else config.planner.extremes,
            generator=generator,
        )
        corrects = config.referee.rule == "expected_cost" and config.arm != "model_free"
        self.belief = Belief(self.policies, self.virtual, corrects=corrects)
        self.clearance = Clearance(system_of(env), self.policies, self.virtual, config.limits)
        self.learning = Learning(self.learner, self.virtual)
        self.planning = MultiStart(self.planner, self.belief, config.planner, make_policy)
        self.imitation = Imitation(self.belief, self.judged)
        self.actor = LivePolicy(twin.plant, self.policies[self.referee.live], config.exploration, generator=generator)
        self.collector = env if isinstance(env, Operation) else collector_of(env, self.actor, twin.plant)
        self.flights = RealFlights(env, self.actor, lambda: self.collector.rollout(), twin.plant, config.least_sound)
        self.operating = Operating(env, self) if isinstance(env, Operation) else None
        self.episodes_done = 0
        self.earlier = EarlierClosure(twin, model_based, self.planner, generator, self.assimilation)

    @property
    def judged(self) -> int:
        """Number N of virtual episodes on which policies are judged."""
        return self.config.planner.receding_horizon.virtual_episodes if self.fed_back else self.config.virtual_episodes

    def episode(self, tell: Callable[[str], None] = lambda step: None) -> EpisodeReport:
        """Fly one real episode and learn from it: the six steps of the paper, in order.

        Args:
            tell: function that is called with the name of every step when the step begins.

        Returns:
            ``real_cost``, ``live``, what the steps of this arm report, and the ``seconds`` of each step.
        """
        arm, report, seconds = self.config.arm, findings(), {}
        self.flights.begin()
        steps = [self.start] if self.first is not None and not self.episodes_done else []
        steps += [self.interact, self.update_model_free] if arm != "model_based" else [self.interact]
        steps += [] if arm == "model_free" else [self.fit_exogenous, self.assimilate, self.examine, self.plan]
        steps += [self.switch_policies] if arm == "twinning" else []
        for step in steps:
            safe_point()
            tell(step.__name__)
            start = time.perf_counter()
            merged(report, self.earlier.sound(step) if step in (self.plan, self.switch_policies) else step())
            seconds[step.__name__] = time.perf_counter() - start
        self.episodes_done += 1
        self.operating.hand_over(self.referee.live, self.episodes_done) if self.operating else None
        return EpisodeReport(report.update({"seconds": findings(**seconds)}))

    def start(self) -> TensorDict:
        """Before the first episode, twin and policies learn what ``first`` knows (paper: random weights)."""
        assert self.first is not None
        pupils = self.first.take(self.policies, self.twin.closure)
        self.assimilation.begin()
        for part in (self.learner, self.planner):
            part.restart()
        if not pupils:
            return findings()
        flights = self.first.flights(self.operating.fly_first if self.operating else self.flights.fly_first)
        on_twin, records = self.config.arm != "model_free", [flight.record for flight in flights]
        for flight in flights:
            self.keep(flight)
            self.virtual.learn(flight.record) if on_twin else None
        if on_twin:
            self.assimilate(records)
            self.assimilation.explain(self.belief.replayed(records), self.generator)
            self.planning.remember() if "model_based" in pupils else None
        imitating = {role: self.policies[role] for role in pupils}
        found = self.imitation.begin(self.first.teacher, imitating, batch_of(records), on_twin=on_twin)
        if len(records[-1].actions) != self.twin.plant.n_steps:
            self.short_term.clear()  # later records are whole episodes
            self.virtual.processes.clear()
        return merged(found, findings(start_cost=torch.stack([flight.cost for flight in flights]).mean()))

    def interact(self) -> TensorDict:
        """Step 1: one episode on the real system; transitions go to D_L with their TD errors, the record to D_S."""
        if self.operating is not None:
            return self.operating.take(self.referee.live, self.episodes_done)
        live, strength = self.referee.live, self.config.exploration.strength(self.episodes_done)
        cleared = self.clearance.choose(live, self.judged)
        acting, live = cleared.policy, cleared.role
        flight = self.flights.fly(acting, strength=strength, whole=self.virtual.wanting(self.config.arm))
        self.keep(flight)
        explored = self.actor.strength * self.config.exploration.spread
        if flight.whole:  # costs of parts cannot be compared with those of episodes
            self.belief.append(flight.record, live, flight.cost.item(), explored, acting.state_dict())
        report = merged(flight.report(), findings(exploration=self.actor.strength)).set_non_tensor("live", live)
        report = merged(merged(report, cleared.report), self.clearance.counted(flight.record))
        return report.update(findings(**acting.report()) if isinstance(acting, StateFeedback) else {})

    def keep(self, flight: Flight) -> None:
        """Both memories hold the sound part of an episode; of those that are refused, none does."""
        self.learning.store(flight.parts(self.twin.plant.dt))
        self.short_term.append(flight.record)

    def update_model_free(self) -> TensorDict:
        """Step 2: the learner improves π_mf."""
        self._earlier_weights = {role: weight_vector(policy) for role, policy in self.policies.items()}
        return self.learning.update()

    def fit_exogenous(self) -> TensorDict:
        """Step 3: fit a Gaussian process to the exogenous input of this episode, if it is whole."""
        self.virtual.learn_flight(self.flights.latest)
        return findings()

    def assimilate(self, records: Sequence[Trajectory] = ()) -> TensorDict:
        """Step 4: n_G gradient steps on J_p over virtual trajectories with stored actions, of D_S or ``records``."""
        latest, processes = self.virtual.paired(list(records or self.short_term))
        self.earlier.remember()
        found = self.assimilation.update(latest, processes, self.config.realisations, self.generator)
        fit = findings(J_p_before=found.start, J_p=found.best, closure_gradient=found.gradient, closure_refused=0.0)
        return merged(fit, findings(**self.assimilation.report()))

    def examine(self) -> TensorDict:
        """Compare what the latest real episodes cost with what the twin says of them, and seek an explanation."""
        found = self.belief.examine()
        if not self.assimilation.explain(self.belief.unexplained, self.generator):
            return found
        return merged(findings(**self.assimilation.report()), self.belief.examine())

    def plan(self) -> TensorDict:
        """Step 5: the planner improves π_mb on the twin with w_p*; a plan stays if it is expected to cost less."""
        count = self.config.planner.realisations or self.config.realisations
        plan_on, judged_on = map(self.virtual.draw, (count, self.judged))
        return self.planning.plan(self.episodes_done + 1, plan_on, judged_on)

    @torch.no_grad()
    def switch_policies(self) -> TensorDict:
        """Step 6: the referee decides, by what both policies cost over the same N virtual episodes.

        Raises:
            DivergenceError: if the twin diverges under the weights that have just flown, too.
        """
        judged_on, live, idle = self.virtual.draw(self.judged), self.referee.live, self.referee.idle
        judged = self.learning.judge(judged_on, self.belief) if self.belief.corrects else findings()
        costs = {role: self.belief.judge(self.policies[role], judged_on) for role in ROLES}
        diverged = [f"{role} diverges on the twin" for role in ROLES if not math.isfinite(costs[role].price)]
        if diverged:
            self.belief.require_sound_twin(judged_on)
        change = weight_change(self.policies[idle], self._earlier_weights[idle])
        evidence = Evidence(
            live_cost=costs[live].expected,
            idle_cost=costs[idle].expected,
            idle_weight_change=change.item(),
            real_costs=tuple(one.cost for one in self.belief.flown),
        )
        event = self.referee.decide(evidence)
        report = findings(*diverged, **{f"J_a_{role}": costs[role].price for role in ROLES}, weight_change=change)
        report = merged(judged, report).set_non_tensor("event", event)
        return merged(report, self.clone(judged_on)) if event == "clone" else report

    def clone(self, judged_on: Scenario) -> TensorDict:
        """Clone the live policy into the idle one, unless the clone is worse."""
        live, idle = self.referee.live, self.referee.idle
        report = self.imitation.clone(
            *(self.policies[role] for role in (live, idle)),
            seen=self.learner.observations,
            record=self.short_term[-1],
            judged_on=judged_on,
        )
        if "reason" not in report:
            (self.learner if idle == "model_free" else self.planner).restart()
        return report

    def state_dict(self) -> dict[str, Any]:
        """State of every component, which the next episode depends on, in tensors and plain containers."""
        return {
            "episodes_done": self.episodes_done,
            "generator": self.generator.get_state(),
            "policies": {role: policy.state_dict() for role, policy in self.policies.items()},
            "closure": self.twin.closure.state_dict(),
            **{name: getattr(self, name).state_dict() for name in COMPONENTS},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of an algorithm that was built with the same arguments.

        Raises:
            ValueError: if the state of a component does not fit; it names the component.
        """
        state = state | on_device({name: state[name] for name in KEPT}, self.generator.device)
        parts: dict[str, tuple[Any, Any]] = {r: (policy, state["policies"][r]) for r, policy in self.policies.items()}
        parts |= {name: (getattr(self, name), state[name]) for name in COMPONENTS}
        load_parts(parts | {"closure": (self.twin.closure, state["closure"])})
        self.generator.set_state(state["generator"].cpu())
        self.episodes_done = state["episodes_done"]


KEPT = ("virtual", "short_term", "belief")  # they leave the tensors of their state on their device
COMPONENTS = ("env", "learner", "planner", "planning", "referee", "assimilation", "clearance", *KEPT)


def share_critic(learner: object, policy: nn.Module) -> None:
    """Give model predictive control the cost-to-go of the model-free half, if it is to price the end of its windows.

    Raises:
        ValueError: if the learner has no method ``cost_to_go``.
    """
    if isinstance(policy, PredictiveControl) and policy.terminal == "critic":
        cost_to_go = getattr(learner, "cost_to_go", None)
        if cost_to_go is None:
            raise ValueError(
                f"terminal='critic' of the receding horizon needs a learner with a method cost_to_go(observation); "
                f"{type(learner).__name__} has none. Use terminal plant."
            )
        policy.value = cost_to_go
