r"""Reinforcement Twinning: the paper's algorithm as a sequence of six TensorDict modules.

There are two policies of the same observation, π_mf (model-free) and π_mb (model-based). One is live: it acts on the
real system. The other is idle: it learns at the same time and can take over. One TensorDict, the episode, flows through
the steps:

| key | shape, unit | written by | read by |
|---|---|---|---|
| ``number`` | number of the episode, from 0 | the algorithm | 1, 5 |
| ``live`` | role of the policy that acts | the algorithm, 1 | 1, 4, 6 |
| ``record/states``, ``actions``, ``exogenous``, ``start`` | n+1 × n_s, n × n_a, n × n_z, [s] | 1 | 3, 4, 6 |
| ``record/whole`` | whether it is that of a whole episode, to its horizon or to its early end | 1 | 3, 4 |
| ``transitions/k`` | n_k transitions of each sound part | 1 | 2 |
| ``real_cost`` | J_a as measured | 1 | |
| ``weight_changes/model_free``, ``/model_based`` | relative change ‖Δw‖/‖w‖ | 2, 5 | 6 |
| ``large_scale`` | n × n_z, units of the inputs | 3 | 4, 5 |
| ``J_p_before``, ``J_p`` | cost of the twin on the records | 4 | 5 |
| ``J_a_plan_before``, ``J_a_plan`` | mean J_a on the twin, in the virtual episodes that judge plans | 5 | |
| ``event`` | keep, swap or clone | 6 | |
| ``J_a_model_based``, ``J_a_model_free`` | mean J_a on the twin | 6 | |
| ``seconds/STEP`` | wall time [s] | the algorithm | |

and what each step reports beside. What lasts between episodes belongs to the steps, whose ``state_dict`` has it.
"""

import copy
import dataclasses
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.utils._pytree import tree_map_only
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase

from rt_torchrl.interruption import safe_point
from rt_torchrl.steps.assimilate import Assimilate, Assimilation
from rt_torchrl.steps.belief import Belief, equal
from rt_torchrl.steps.config import EXPERIENCE, Role, TwinningConfig
from rt_torchrl.steps.hypotheses.assimilation import EnsembleAssimilation
from rt_torchrl.steps.hypotheses.ensemble import TwinEnsemble
from rt_torchrl.steps.inputs import EXTREMES, FitInputs, VirtualEpisodes
from rt_torchrl.steps.interact import Interact, Operate, RealFlights, Supervisor
from rt_torchrl.steps.learn import ActorCritic, Learn, Learner
from rt_torchrl.steps.plan import MultiStart, Planner, make_planner
from rt_torchrl.steps.report import merged, metrics
from rt_torchrl.steps.start import Start, first_live
from rt_torchrl.steps.switch import DecisionTree, Imitation, Referee, Switch
from rt_torchrl.systems.collectors import MakeCollector, collector_of
from rt_torchrl.systems.exploration import LivePolicy
from rt_torchrl.systems.operation import FIRST, Operation, system_of
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import batch_of
from rt_torchrl.trajectories.twin import DigitalTwin

ARMS = {
    "twinning": ("interact", "learn", "inputs", "assimilate", "plan", "switch"),
    "model_free": ("interact", "learn"),
    "model_based": ("interact", "inputs", "assimilate", "plan"),
}
"""Steps of each arm, in their order."""
OFTEN = 20
"""How many times as many virtual episodes policies are judged in where episodes may end early: an end in one of a
hundred, which twenty do not hold, decides which policy is the better one."""


class ReinforcementTwinning(TensorDictSequential):
    """The algorithm; call :meth:`episode` once per real episode.

    A step of one's own, any TensorDict module, goes in by :meth:`insert` and takes the place of another one by
    ``algorithm.module["plan"] = ...``.

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
        make_collector: function of the real system, the live policy and the plant that makes the TorchRL collector of
            step 1; a batch is a whole episode. An :class:`Operation` has its own.
        make_policy: function that draws a random policy like ``model_based``; by default that of the plant.

    Raises:
        ValueError: if the real system's batch size is not 1, or learner or planner train other policies.
    """

    module: nn.ModuleDict
    env: EnvBase | Operation
    actor: LivePolicy
    collector: Operation | BaseCollector
    learner: Learner
    planner: Planner
    referee: Referee
    first: Start | None
    operating: Operate | None

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
        make_collector: MakeCollector = collector_of,
        make_policy: Callable[[torch.Generator], nn.Module] | None = None,
    ):
        policies: dict[Role, nn.Module] = {"model_free": model_free, "model_based": model_based}
        if first is not None:
            config = dataclasses.replace(config, exploration=config.exploration.imitating())
        learner = learner or ActorCritic(twin.plant, model_free, config.learner, generator=generator)
        planner = planner or make_planner(twin, model_based, config.planner)
        referee = referee or DecisionTree(config.referee, first_live(config.arm, first))
        halves: dict[Role, Learner | Planner] = {"model_free": learner, "model_based": planner}
        for role, half in halves.items():
            if half.policy is not policies[role]:
                raise ValueError(f"{type(half).__name__} trains another policy than {role}; build it with that module.")
        modules = [twin.closure, *(policy for policy in policies.values() if not isinstance(policy, StateFeedback))]
        moved = [{id(w) for w in module.parameters() if w.requires_grad} for module in modules]
        if len(set.union(*moved)) < sum(map(len, moved)):
            raise ValueError(
                "model_free, model_based and the twin's closure share trainable weights, which one step would move "
                "under another; give each module its own, such as a copy.deepcopy."
            )
        fed_back = isinstance(model_based, StateFeedback)  # it plans on the twin alone while it acts
        judged = config.planner.receding_horizon.virtual_episodes if fed_back else config.virtual_episodes
        extremes = EXTREMES if config.planner.method == "multi_start" else 0
        if extremes and twin.plant.end_cost is not None:  # many episodes hold extreme starts, too
            judged, extremes = OFTEN * judged, 0
        kept = max(config.records, 1 if config.planner.method == "single_start" else EXPERIENCE)
        virtual = VirtualEpisodes(twin, config.exogenous, kept, extremes=extremes, generator=generator)
        corrects = config.referee.rule == "expected_cost" and config.arm != "model_free"
        belief, system = Belief(policies, virtual, corrects=corrects), system_of(env)
        actor = LivePolicy(twin.plant, policies[referee.live], config.exploration, generator=generator)
        collector = env if isinstance(env, Operation) else make_collector(env, actor, twin.plant)
        rollout = collector.rollout if isinstance(collector, Operation) else lambda: next(iter(collector))
        flights = RealFlights(env, actor, rollout, twin.plant)
        trained = {role: policy for role, policy in policies.items() if config.arm in ("twinning", role)}
        teacher = None if first is None else first.teacher
        supervisor = Supervisor(system, trained, belief, config.limits, judged, teacher)
        operating = isinstance(env, Operation)
        interact = (Operate if operating else Interact)(flights, supervisor, belief, config)
        assimilation = Assimilation(twin, config.assimilation)
        if isinstance(twin, TwinEnsemble):
            assimilation = EnsembleAssimilation(twin, config.assimilation, config.hypotheses, always=fed_back)
        counts = (config.planner.realisations or config.realisations, judged)
        steps: dict[str, Any] = {
            "interact": interact,
            "learn": Learn(learner, belief, judged),
            "inputs": FitInputs(virtual),
            "assimilate": Assimilate(assimilation, belief, interact.short_term, config.realisations),
            "plan": MultiStart(planner, belief, config.planner, counts, make_policy),
            "switch": Switch(referee, Imitation(belief, judged), learner, planner),
        }
        super().__init__(OrderedDict((name, steps[name]) for name in ARMS[config.arm]))
        self.closure, self.model_free, self.model_based = twin.closure, model_free, model_based
        self.twin, self.config, self.generator, self.policies = twin, config, generator, policies
        self.virtual, self.belief, self.assimilation, self.flights = virtual, belief, assimilation, flights
        self.short_term, self.steps = interact.short_term, steps
        self.episodes_done = 0
        # These may be modules, but no sub-modules: what lasts of them belongs to the steps.
        parts = {"env": env, "actor": actor, "collector": collector, "first": first}
        parts["operating"] = interact if operating else None
        self.__dict__.update(parts, learner=learner, planner=planner, referee=referee)

    def insert(self, name: str, step: TensorDictModuleBase, *, before: str) -> None:
        """Insert a step of one's own.

        Args:
            name: name of the step, under which its seconds are reported.
            step: the step, a TensorDict module.
            before: name of the step that it comes before.

        Raises:
            ValueError: if there is no such step.
        """
        if before not in self.module:
            raise ValueError(f"before={before!r} is no step of this arm; choose one of {', '.join(self.module)}.")
        old, self.module = dict(self.module.items()), nn.ModuleDict()
        for known, module in old.items():
            if known == before:
                self.module[name] = step
            self.module[known] = module

    def episode(self, tell: Callable[[str], None] = lambda step: None) -> TensorDictBase:
        """Fly one real episode and learn from it: the steps of the arm, in their order.

        Args:
            tell: function that is called with the name of every step when the step begins.

        Returns:
            ``real_cost``, ``live``, all numbers and texts that the steps of this arm have set, and the ``seconds`` of
            each step.
        """
        flown = self(TensorDict({"number": self.episodes_done}), tell=tell)
        self.episodes_done += 1
        if self.operating is not None:
            self.operating.hand_over(self.referee.live, self.episodes_done)
        # Numbers, texts and seconds are the report; all else is data that flows between the steps.
        keys = [key for key in flown.keys() if key != "seconds" and not isinstance(flown[key], str)]  # noqa: SIM118
        data = [key for key in keys if isinstance(flown[key], TensorDictBase) or flown[key].numel() != 1]
        return flown.exclude("number", *data)

    def forward(self, episode: TensorDictBase, *, tell: Callable[[str], None] = lambda step: None) -> TensorDictBase:
        """Let an episode flow through the steps, after the start before the first one; see :meth:`episode`."""
        if "live" not in episode:
            episode.set_non_tensor("live", self.referee.live)
        steps: dict[str, Callable[[TensorDictBase], TensorDictBase]] = dict(self.module.items())
        if self.first is not None and not self.episodes_done:
            steps = {"start": partial(self.start, tell=tell)} | steps
        self.flights.faults = []
        for name, step in steps.items():
            safe_point()
            tell(name)
            start = time.perf_counter()
            episode = self._sound(step, episode) if name in ("plan", "switch") else step(episode)
            episode["seconds", name] = time.perf_counter() - start
        return episode

    def start(
        self, episode: TensorDictBase | None = None, *, tell: Callable[[str], None] = lambda part: None
    ) -> TensorDictBase:
        """Before the first episode, twin and policies learn what ``first`` knows (paper: random weights).

        A step of one's own, or one that is left out, takes no part.
        """
        assert self.first is not None
        episode = TensorDict() if episode is None else episode
        pupils = self.first.take(self.policies, self.twin.closure)
        self.assimilation.begin()
        for half in (self.learner, self.planner):
            half.restart()
        if not pupils:
            return episode
        flights = self.first.flights(self.steps["interact"].fly_first)
        on_twin, records = self.config.arm != "model_free", [flight.record for flight in flights]
        taken = [name for name, step in self.module.items() if step is self.steps[name]]
        counted = len(records[-1].actions) + flights[-1].after[0]
        for flight in flights:
            if "learn" in taken:
                self.steps["learn"].store(flight.parts)
            self.short_term.append(flight.record)
            if self.first.teacher is not None:
                self.belief.append(flight.record, FIRST, flight.cost.item())
            if on_twin:
                self.virtual.learn(flight.record)
        if "assimilate" in taken:
            tell("fit")
            self.steps["assimilate"].fit(records)
            self.assimilation.explain(self.belief.replayed(records, counted))
        tell("imitation")
        imitating = {role: self.policies[role] for role in pupils}
        imitation, flown = self.steps["switch"].imitation, batch_of(records)
        cost = torch.stack([flight.cost for flight in flights]).mean().item()
        report = imitation.begin(self.first.teacher, imitating, flown, cost)
        if counted != self.twin.plant.n_steps:  # later records are those of whole episodes
            self.short_term.clear()
            self.virtual.processes.clear()
        if self.first.teacher is not None:  # nobody pays for a log again
            report = merged(report, metrics(start_cost=cost))
        return merged(episode, report)

    def conclude(self) -> bool:
        """After the last episode: a plan that no flight has tried does not stay if real episodes contradict the twin.

        The live policy then gets those weights of the last that have flown that are expected to cost least.

        Returns:
            Whether the live policy has changed.
        """
        policy, plan = self.policies[self.referee.live], self.steps["plan"]
        tried = any(equal(flight.weights, policy.state_dict()) for flight in self.belief.flown)
        if tried or not self.belief.corrects or not self.belief.contradicted:
            return False
        best = self.belief.best_flown(policy, self.virtual.draw(plan.counts[1]))
        if best is not None:
            policy.load_state_dict(best[0])
        return best is not None

    def _sound(self, step: Callable[[TensorDictBase], TensorDictBase], episode: TensorDictBase) -> TensorDictBase:
        """Take a step that relies on the twin; the one rollback of the algorithm.

        The weights that have just flown did not diverge on the real system. If the twin diverges with them, the closure
        must be wrong, and the step is repeated with the closure of the last episode, then with the first one. Any other
        policy may diverge on a sound twin, and loses. Where it diverges with the first closure too, the step is left
        out: the real system goes on. Note: the paper keeps every closure.

        An interrupt or another error gives π_mb its weights back: it may have those of half a plan.
        """
        policy, state = copy.deepcopy(self.model_based.state_dict()), self.generator.get_state()
        kept = [self.steps["assimilate"].closure_before, self.assimilation.first]
        closures, reasons = [closure for closure in kept if closure is not None], list[str]()
        try:
            while True:
                try:
                    result = step(episode)
                    return merged(result, metrics(*reasons, closure_refused=1.0)) if reasons else result
                except DivergenceError as error:
                    if not closures:
                        self.model_based.load_state_dict(policy)
                        left_out = metrics(*reasons, f"step left out: {error}", closure_refused=1.0, alarm=1.0)
                        warning = f"the twin diverges under a policy that has flown: {error}"
                        return merged(episode, left_out.set_non_tensor("warning", warning))
                    reasons = reasons or [f"closure refused: {error}"]
                self.model_based.load_state_dict(policy)  # state feedback holds the refused closure too
                self.twin.closure.load_state_dict(closures.pop(0))
                self.steps["assimilate"].closure_before = None
                self.twin.retreat()
                self.generator.set_state(state)
                self.planner.restart()
        except BaseException:
            self.model_based.load_state_dict(policy)
            raise

    def get_extra_state(self) -> dict[str, Any]:
        """What the next episode depends on beside policies, closure and the state of the steps."""
        return {"episodes_done": self.episodes_done, "generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.episodes_done = state["episodes_done"]
        self.generator.set_state(state["generator"].cpu())

    def load_state_dict(self, state: dict[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """Go on from the :meth:`state_dict` of an algorithm that was built with the same arguments.

        Raises:
            ValueError: if the state of a part does not fit; it names the part.
        """
        moved = tree_map_only(Tensor, lambda tensor: tensor.to(self.generator.device), state)
        try:
            return super().load_state_dict(moved, strict, assign)
        except RuntimeError as error:
            raise ValueError(f"the saved state of policies or closure does not fit: {error}") from error
