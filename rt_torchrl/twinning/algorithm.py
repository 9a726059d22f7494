r"""Reinforcement Twinning: the six steps of the paper's algorithm, one method each.

Two policies of the same observation live side by side, π_mf (model-free) and π_mb (model-based). One is live: it acts
on the real system. The other is idle, learns beside it and can take over.
"""

import copy
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.envs import EnvBase

from rt_torchrl.interruption import safe_point
from rt_torchrl.systems.collectors import EpisodeCollector, FlightCollector
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.trajectories.trajectory import DivergenceError, Record
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import Assimilation, AssimilationConfig
from rt_torchrl.twinning.distillation import Distillation, DistillationConfig, same_architecture
from rt_torchrl.twinning.exogenous import ExogenousConfig, ExogenousProcess, sample_experience
from rt_torchrl.twinning.memory import LongTermMemory, LongTermMemoryConfig, ShortTermMemory
from rt_torchrl.twinning.model_based import ModelBased, ModelBasedConfig, VirtualEpisodes
from rt_torchrl.twinning.model_free import ModelFree, ModelFreeConfig
from rt_torchrl.twinning.switching import PolicySwitch, Role, SwitchConfig

Arm = Literal["twinning", "model_free", "model_based"]


@dataclass(frozen=True, kw_only=True)
class TwinningConfig:
    """Hyper-parameters of the algorithm, by step.

    Args:
        arm: ``twinning``, or one of its halves alone: ``model_free`` makes steps 1 and 2, ``model_based`` 1 and 3 to 5.
        realisations: N_z, samples of the exogenous process per record in steps 4 and 5.
        records: n_S, real episodes that steps 3 to 5 look back on.
        virtual_episodes: N, over which step 5 judges a plan and step 6 compares the policies.
        exploration: step 1.
        long_term: the memory of step 2.
        model_free: step 2.
        exogenous: step 3.
        assimilation: step 4.
        model_based: step 5.
        switch: step 6.
        distillation: how step 6 clones between policies of different architectures.
    """

    arm: Arm = "twinning"
    realisations: int = 5
    records: int = 1
    virtual_episodes: int = 20
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    long_term: LongTermMemoryConfig = field(default_factory=LongTermMemoryConfig)
    model_free: ModelFreeConfig = field(default_factory=ModelFreeConfig)
    exogenous: ExogenousConfig = field(default_factory=ExogenousConfig)
    assimilation: AssimilationConfig = field(default_factory=AssimilationConfig)
    model_based: ModelBasedConfig = field(default_factory=ModelBasedConfig)
    switch: SwitchConfig = field(default_factory=SwitchConfig)
    distillation: DistillationConfig = field(default_factory=DistillationConfig)

    def __post_init__(self):
        for argument in ("realisations", "records", "virtual_episodes"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least 1.")


class ReinforcementTwinning:
    """The algorithm; call :meth:`episode` once per real episode.

    Args:
        env: the real system; a :class:`PlantEnv` of batch size 1, or a :class:`RealSystem` around any environment.
        twin: the digital twin, whose closure is trained in place.
        model_free: π_mf, trained in place; starts live.
        model_based: π_mb, trained in place.
        config: see :class:`TwinningConfig`.
        generator: source of everything random except what the real system draws itself.
    """

    def __init__(
        self,
        env: EnvBase,
        twin: DigitalTwin,
        *,
        model_free: nn.Module,
        model_based: nn.Module,
        config: TwinningConfig,
        generator: torch.Generator,
    ):
        self.env, self.twin, self.config, self.generator = env, twin, config, generator
        self.policies: dict[Role, nn.Module] = {"model_free": model_free, "model_based": model_based}
        self.model_free = ModelFree(twin.plant, model_free, config.model_free, generator=generator)
        self.assimilation = Assimilation(twin, config.assimilation)
        self.model_based = ModelBased(twin, model_based, config.model_based, generator=generator)
        self.distillation = Distillation(twin, config.distillation)
        self.long_term = LongTermMemory(config.long_term, generator=generator)
        self.short_term = ShortTermMemory(config.records)
        self.processes: deque[ExogenousProcess] = deque(maxlen=max(config.records, config.model_based.experience))
        self.switch = PolicySwitch(config.switch, live="model_based" if config.arm == "model_based" else "model_free")
        self.actor = LivePolicy(twin.plant, self.policies[self.switch.live], config.exploration, generator=generator)
        simulated = isinstance(env, PlantEnv)
        self.collector = (
            FlightCollector(env, self.actor) if simulated else EpisodeCollector(env, self.actor, twin.plant.n_steps)
        )
        self.episodes_done = 0
        self._earlier_closure: dict[str, Any] | None = None

    def episode(self) -> TensorDict:
        """One real episode and all that is learned from it: the six steps of the paper, in order.

        Returns:
            ``real_cost``, the reports of the steps that were made, and ``seconds`` of each step.
        """
        arm, report, seconds = self.config.arm, findings(), {}
        steps = [self.interact]
        steps += [self.update_model_free] if arm != "model_based" else []
        steps += [self.fit_exogenous, self.assimilate, self.plan] if arm != "model_free" else []
        steps += [self.switch_policies] if arm == "twinning" else []
        for step in steps:
            safe_point()
            start = time.perf_counter()
            report.update(self.on_sound_twin(step) if step in (self.plan, self.switch_policies) else step())
            seconds[step.__name__] = time.perf_counter() - start
        self.episodes_done += 1
        return report.update({"seconds": findings(**seconds)})

    def interact(self) -> TensorDict:
        """Step 1: one episode on the real system; transitions go to D_L with their TD errors, the record to D_S."""
        self.actor.begin(self.policies[self.switch.live], strength=self.config.exploration.strength(self.episodes_done))
        episode = next(iter(self.collector))[0]
        # What is learned from is the action that was applied.
        episode["action"] = episode["next", "applied"]
        transitions = self.model_free.transitions(episode)
        self.long_term.store(transitions, self.model_free.td_errors(transitions))
        states = torch.cat([episode["state"], episode["next", "state"][-1:]])
        self.short_term.append(Record(states, episode["exogenous"], episode["action"]))
        reward = episode["next", "reward"].mean()
        return findings(real_cost=-reward, reward=reward, exploration=self.actor.strength)

    def update_model_free(self) -> TensorDict:
        """Step 2: n_Q updates of the critic, then n_A of π_mf."""
        self._earlier_weights = {role: weight_vector(policy) for role, policy in self.policies.items()}
        return self.model_free.update(self.long_term, self.twin.plant.n_steps)

    def fit_exogenous(self) -> TensorDict:
        """Step 3: a Gaussian process of the exogenous input of this episode."""
        plant, record = self.twin.plant, self.short_term[-1]
        self.processes.append(
            ExogenousProcess(record.exogenous, dt=plant.dt, signals=plant.inputs, config=self.config.exogenous)
        )
        return findings()

    def assimilate(self) -> TensorDict:
        """Step 4: n_G gradient steps on J_p over n_S × N_z virtual trajectories under the stored actions."""
        processes = list(self.processes)[-len(self.short_term) :]
        self._earlier_closure = copy.deepcopy(self.twin.closure.state_dict())
        found = self.assimilation.update(self.short_term, processes, self.config.realisations, self.generator)
        return findings(J_p_before=found.start, J_p=found.best, closure_gradient=found.gradient, closure_refused=0.0)

    def on_sound_twin(self, step: Callable[[], TensorDict]) -> TensorDict:
        """Step 5 or 6; if the twin diverges in it, the closure of the episode before takes the place of w_p*.

        Note: the paper keeps every closure. One that replays the records best may still be one that no other flight can
        be made with, where noise of the sensors is large beside what the closure does; the real system cannot wait.

        Raises:
            DivergenceError: if the twin diverges with the earlier closure too.
        """
        state, policy = self.generator.get_state(), copy.deepcopy(self.policies["model_based"].state_dict())
        try:
            return step()
        except DivergenceError as error:
            if self._earlier_closure is None:
                raise
            refused = f"closure refused: {error}"
        self.twin.closure.load_state_dict(self._earlier_closure)
        self._earlier_closure = None
        self.generator.set_state(state)
        self.policies["model_based"].load_state_dict(policy)
        self.model_based.restart()
        report = step()
        return report.update(findings(closure_refused=1.0)).set_non_tensor("reason", refused)

    def plan(self) -> TensorDict:
        """Step 5: n_mb gradient steps on J_a over N_z virtual trajectories under π_mb, on the twin with w_p*."""
        count = self.config.model_based.realisations or self.config.realisations
        planned_on, judged_on = map(self.draw_virtual_episodes, (count, self.config.virtual_episodes))
        found, accepted = self.model_based.update(planned_on, judged_on)
        return findings(
            J_a_plan_before=found.start,
            J_a_plan=found.best,
            policy_gradient=found.gradient,
            plan_accepted=float(accepted),
        )

    def draw_virtual_episodes(self, count: int) -> VirtualEpisodes:
        """Random initial states, and exogenous inputs from the processes of the episodes so far.

        Note: the paper plans from the initial state and with the disturbances of the last episode alone; here from
        random ones and with those of all episodes (``experience``), because a policy that is optimal for one wind can
        lie just beyond a cliff of another: the turbine's torque law then stalls the rotor in one wind of twenty.
        """
        initial_state = self.twin.plant.draw_initial_state(count, self.generator)
        return VirtualEpisodes(initial_state, sample_experience(self.processes, count, self.generator))

    @torch.no_grad()
    def switch_policies(self) -> TensorDict:
        """Step 6: mean J_a of both policies over the same N virtual episodes, then the decision tree."""
        judged_on = self.draw_virtual_episodes(self.config.virtual_episodes)
        costs = self.virtual_costs(judged_on)
        idle = self.switch.idle
        now = weight_vector(self.policies[idle])
        change = (now - self._earlier_weights[idle]).norm() / now.norm()
        event = self.switch.decide(costs[self.switch.live].item(), costs[idle].item(), change.item())
        report = findings(**{f"J_a_{role}": cost for role, cost in costs.items()}, weight_change=change)
        report.set_non_tensor("event", event)
        return report.update(self.clone(costs, judged_on)) if event == "clone" else report

    def virtual_costs(self, episodes: VirtualEpisodes) -> dict[Role, Tensor]:
        """Mean J_a of each policy over virtual episodes."""
        return {role: self.twin.cost(policy, *episodes) for role, policy in self.policies.items()}

    def clone(self, costs: dict[Role, Tensor], judged_on: VirtualEpisodes) -> TensorDict:
        """The live policy into the idle one: a copy of its weights, or a distillation into another architecture.

        Args:
            costs: mean J_a of both policies over ``judged_on``, where a distilled clone must not cost more than the
                policy it replaces.
            judged_on: virtual episodes.
        """
        live, idle = (self.policies[role] for role in (self.switch.live, self.switch.idle))
        report = findings()
        if same_architecture(live, idle):
            idle.load_state_dict(live.state_dict())
        else:
            found = self.distillation.clone(
                live,
                idle,
                seen=self.long_term.observations(),
                draw=lambda: self.draw_virtual_episodes(self.config.virtual_episodes),
                judged_on=judged_on,
                to_beat=costs[self.switch.idle].item(),
            )
            ratio = found.cost / costs[self.switch.live]
            report.update(findings(distillation_error=found.error, distillation_cost_ratio=ratio))
            if not found.accepted:
                reason = f"clone refused: J_a {found.cost:.4g} of it, {costs[self.switch.idle]:.4g} of what it replaces"
                return report.set_non_tensor("event", "keep").set_non_tensor("reason", reason)
        (self.model_free if self.switch.idle == "model_free" else self.model_based).restart()
        return report


def findings(**values: float | Tensor) -> TensorDict:
    """Scalars in double precision."""
    return TensorDict({key: torch.as_tensor(value, dtype=torch.float64).detach() for key, value in values.items()})


def weight_vector(module: nn.Module) -> Tensor:
    """All weights of a module, detached, in one vector."""
    return torch.cat([weight.detach().flatten() for weight in module.parameters()]).clone()
