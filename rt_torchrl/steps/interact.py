"""Step 1: one episode on the real system, what of it is sound, and which policy may act."""

import copy
import functools
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from rt_torchrl.control.predictive_control import affordable
from rt_torchrl.plants.plant import Plant
from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import Pilot, Role, TwinningConfig
from rt_torchrl.steps.report import Step, in_words, merged, metrics
from rt_torchrl.systems.config import OperatingLimitsConfig
from rt_torchrl.systems.exploration import LivePolicy
from rt_torchrl.systems.operation import FIRST, Operation
from rt_torchrl.systems.safety import OperatingLimits, SafetyReport, report_of, require_layer
from rt_torchrl.systems.sound_part import (
    FLIGHTS,
    EpisodeEndedError,
    Fault,
    SoundPart,
    sound_part,
    tried_in_vain,
)
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import SHORTEST, Scenario, Trajectory


class ShortTermMemory(deque[Trajectory]):
    """The records of the last ``maxlen`` real episodes, oldest first."""

    def state_dict(self) -> dict[str, Any]:
        return {"records": [record._asdict() for record in self]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.clear()
        self.extend(Trajectory(**record) for record in state["records"])


LEAST_SOUND = 0.5
"""Least share of a real episode in one sound part, below which it is flown again."""
EQUAL = 1.05
"""Cost that is expected of a policy over that of the controller that flew first, up to which it may act."""
TWICE = 2.0
"""The same where the twin is wrong: the flight shows how the real system answers other actions, without which plans do
not improve."""


class Flight(NamedTuple):
    """A real episode that can be learned from.

    Attributes:
        transitions: the transitions of its longest sound part, whose action is the applied one.
        record: the trajectory of that part; its clock says where it begins.
        parts: the transitions of all sound parts, in their order.
        refused: why earlier attempts could not be learned from.
        whole: whether the record is that of a whole episode, to its horizon or to its early end.
        after: number of control intervals after an early end, and what each of them costs, L_e.
        commands: the commands of the record's intervals before the actuators; where a safety layer sent another one,
            what was applied.
    """

    transitions: TensorDict
    record: Trajectory
    parts: Sequence[TensorDict]
    refused: Sequence[str] = ()
    whole: bool = True
    after: tuple[int, float] = (0, 0.0)
    commands: Tensor | None = None

    @property
    def cost(self) -> Tensor:
        """J_a as measured, in the sound part and after an early end."""
        rewards, (count, end_cost) = self.transitions["next", "reward"], self.after
        return -(rewards.sum() - count * end_cost) / (len(rewards) + count)


class RealFlights:
    """Real episodes of the algorithm: each is flown, and flown again if too little of it is sound.

    Args:
        env: the real system, or an operation of one.
        actor: what acts in the rollout.
        rollout: function that flies one episode of batch size 1.
        plant: plant that gives the length of an episode.
    """

    def __init__(self, env: EnvBase | Operation, actor: LivePolicy, rollout: Callable[[], TensorDict], plant: Plant):
        self.env, self.actor, self.rollout, self.plant = env, actor, rollout, plant
        self._least = max(SHORTEST, LEAST_SOUND * plant.n_steps)
        self.faults: list[Fault] = []
        """Faults of the system since the episode of the algorithm began."""
        self.check: Callable[[Trajectory], None] | None = None
        """What looks at the record of the first flight, before anything is learned from it, and may raise."""

    def fly(self, policy: nn.Module, *, strength: float, whole: bool) -> Flight:
        """Fly one episode.

        Args:
            policy: policy that acts.
            strength: strength ξ of the exploration.
            whole: whether only a whole episode will do.

        Raises:
            ValueError: if several episodes in a row cannot be learned from.
        """
        refused: list[str] = []
        while True:
            self.actor.begin(policy, strength=strength)
            episode, sound, failure = self._attempt()
            self.faults += sound.faults
            first, last = sound.longest
            if episode is not None and (sound.whole or (not whole and last - first >= self._least)):
                break
            refused.append(sound.reason)
            if len(refused) == FLIGHTS:
                raise ValueError(tried_in_vain(refused)) from failure
        rows = episode[first:last]
        commands, states = rows["action"].clone(), torch.cat([rows["state"], rows["next", "state"][-1:]])
        events = [] if self._report is None else self._report.events
        changed = [e.step - first for e in events if first <= e.step < last and e.asked != e.applied]
        commands[changed] = rows["next", "applied"][changed]
        parts = [_transitions(episode, part) for part in sound.parts]
        transitions = parts[sound.parts.index((first, last))]
        record = Trajectory(states, rows["next", "applied"], rows["exogenous"], first * self.plant.dt)
        record = record._replace(from_rest=first == 0 and not (isinstance(self.env, Operation) and self.env.continuous))
        after = (self.plant.n_steps - len(episode), self.plant.end_cost or 0.0) if sound.whole else (0, 0.0)
        if self.check is not None:
            check, self.check = self.check, None
            check(record)
        return Flight(transitions, record, parts, refused, sound.whole, after, commands)

    @property
    def _report(self) -> SafetyReport | None:
        """The report of the safety layer about the last episode; None without a layer."""
        return self.env.report if isinstance(self.env, Operation) else report_of(self.env)

    def _attempt(self) -> tuple[TensorDictBase | None, SoundPart, Exception | None]:
        """One episode, its sound part, and the error that ended it."""
        try:
            flown, failure = self.rollout(), None
        except EpisodeEndedError as error:
            flown, failure = error.flown, error
        sound, episode = SoundPart([], [], "", whole=False), None if flown is None else flown[0]
        if episode is not None:
            sound = sound_part(episode, self.plant, self._report)
        if failure is not None:
            n = 0 if episode is None else len(episode)
            faults = [*sound.faults, Fault("ended", n, n * self.plant.dt, str(failure))]
            reason = "; ".join(part for part in (sound.reason, str(failure)) if part)
            sound = sound._replace(faults=faults, reason=reason, whole=False)
        return episode, sound, failure


def _transitions(episode: TensorDictBase, part: tuple[int, int]) -> TensorDict:
    """The transitions of a part of an episode; the last one is truncated, unless the episode ends there early."""
    first, last = part
    transitions = episode[first:last].clone() if last - first < len(episode) else episode
    # The learner learns from the action that was applied.
    transitions["action"] = transitions["next", "applied"]
    transitions["next", "done"][-1] = True
    transitions["next", "truncated"][-1] = ~transitions["next", "terminated"][-1]
    return transitions


class Supervisor:
    """Lets a policy act only if it is expected to keep the limits, and to cost no more than what flew first.

    It may cost up to twice as much where the twin is wrong about what has flown.

    The live policy is asked first, then the idle one. Where neither may act, the weights do that were cleared for the
    limits last, or without these the controller with which the training has begun. Before the first real episode
    nothing is known, and the live policy acts unchecked, behind the safety layer.

    Args:
        env: the real system, which needs a safety layer if there are limits.
        policies: the policies that are trained, by role.
        belief: what policies cost, and the virtual episodes.
        config: the limits.
        count: number of virtual episodes of a check.
        controller: what the training has begun with; None without.

    Raises:
        ValueError: if the plant has no such limits, see :class:`OperatingLimits`, or the real system no safety layer.
    """

    def __init__(
        self,
        env: EnvBase,
        policies: Mapping[Role, nn.Module],
        belief: Belief,
        config: OperatingLimitsConfig,
        count: int,
        controller: nn.Module | None = None,
    ):
        if config:
            require_layer(env)
        self.limits = OperatingLimits(belief.virtual.twin.plant, config) if config else None
        self.policies, self.belief, self.count, self.controller = policies, belief, count, controller
        self._last: dict[str, Any] | None = None
        """The role and weights that were cleared last."""

    @torch.no_grad()
    def choose(self, live: Role) -> tuple[nn.Module, Pilot, dict[str, float | str]]:
        """What may act.

        Args:
            live: role that the referee wants to act.

        Returns:
            What may act, the role whose weights it has or ``first``, and a report with a reason for each policy that is
            refused and, of a policy with limits, ``predicted_violations``, the share of control intervals beyond one.

        Raises:
            ValueError: if nothing may act.
        """
        episodes, refused, report = self.checked(), list[str](), dict[str, float | str]()
        for role in sorted(self.policies, key=lambda role: role != live):  # the live one first
            policy = self.policies[role]
            reason, share = self.refusal(role, episodes)
            if not reason:
                if episodes is not None:
                    self._last = {"role": role, "weights": copy.deepcopy(policy.state_dict())}
                    report["predicted_violations"] = share
                return policy, role, report
            refused.append(reason)
            report["reason"] = "; ".join(refused)
        if self._last is not None and episodes is not None:
            role, policy = self._last["role"], copy.deepcopy(self.policies[self._last["role"]])
            policy.load_state_dict(self._last["weights"])
            return policy, role, report | {"predicted_violations": self.predicted(policy, episodes)}
        if self.controller is not None:
            return self.controller, FIRST, report
        raise ValueError(f"no policy may act. {report['reason']}. Widen the limits, or use --start controller.")

    def checked(self) -> Scenario | None:
        """Virtual episodes in which limits are checked; None without limits, and before anything is known."""
        return None if self.limits is None else self.episodes()

    def episodes(self) -> Scenario | None:
        """Virtual episodes in which policies fly beside the controller, too; the same until others are drawn.

        None before anything is known.
        """
        virtual = self.belief.virtual
        if not virtual.processes:
            return None
        state = virtual.generator.get_state()
        drawn = virtual.draw(self.count)
        virtual.generator.set_state(state)  # so that a training in which all may act is the same without the check
        return drawn

    @torch.no_grad()
    def refusal(self, role: Role, episodes: Scenario | None) -> tuple[str, float]:
        """Why a policy may not act, empty if it may, and the share of control intervals beyond a limit.

        Args:
            role: role of the policy.
            episodes: see :meth:`checked`.
        """
        policy = self.policies[role]
        share = 0.0 if episodes is None else self.predicted(policy, episodes)
        if share > 0.0:
            return f"{role} may not act: it would leave the limits in {100 * share:.3g} % of the intervals", share
        tried = bool(self.belief.flown)
        known = self.belief.beside_first(policy, self.controller) if tried else None
        if not tried or (known is not None and known.expected > EQUAL * known.paid):
            few = affordable(self.controller, self.count)
            if not tried or few == self.count:  # a slow controller flies on the twin for untried policies alone
                episodes = self.episodes() if episodes is None else episodes
                others = None if episodes is None else Scenario(*(values[:few] for values in episodes))
                known = self.belief.beside_first(policy, self.controller, others)
        if known is None or known.expected <= (EQUAL if known.right else TWICE) * known.paid:
            return "", share
        expected, paid = map(in_words, known[:2])
        where = f"where the controller that flew first cost {paid}"
        return f"{role} may not act: it is expected to cost {expected} {where}", share

    def predicted(self, policy: nn.Module, episodes: Scenario) -> float:
        """The share of control intervals of virtual episodes beyond any limit; 1 if the twin diverges."""
        assert self.limits is not None
        try:
            broken = self.limits.broken(self.belief.virtual.twin.control(policy, *episodes))
        except DivergenceError:
            return 1.0
        return torch.stack(list(broken.values())).any(0).double().mean().item()

    def state_dict(self) -> dict[str, Any]:
        return {"last": self._last}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._last = state["last"]


class Interact(Step):
    """Step 1: the live policy flies one episode on the real system.

    Reads ``number``, that of the episode from 0, and ``live``, the role that acts. Writes ``record``, the trajectory of
    the sound part (``states`` n+1 × n_s, ``actions`` n × n_a, ``exogenous`` n × n_z, ``start`` [s], and whether it is
    that of a ``whole`` episode, to its horizon or to its early end), ``transitions`` of all sound parts, by number, as
    TorchRL's collectors give them, and ``real_cost``, J_a as measured.

    Args:
        flights: real episodes of the system.
        supervisor: which policy may act.
        belief: what takes the costs of whole episodes, and has the virtual episodes.
        config: hyper-parameters.
    """

    in_keys = ["number", "live"]
    out_keys = ["record", "transitions", "real_cost", "live"]

    def __init__(self, flights: RealFlights, supervisor: Supervisor, belief: Belief, config: TwinningConfig):
        short_term = ShortTermMemory(maxlen=config.records)
        super().__init__(env=flights.env, supervisor=supervisor, short_term=short_term, belief=belief)
        self.flights, self.supervisor, self.belief, self.short_term = flights, supervisor, belief, short_term
        self.config = config

    @property
    def wanting(self) -> bool:
        """Whether a twin still needs the inputs of one whole real episode."""
        return self.config.arm != "model_free" and not self.belief.virtual.processes

    def forward(self, episode: TensorDictBase) -> TensorDictBase:
        """Take the step."""
        flights, report = self.take(episode["live"], int(episode["number"]))
        states, actions, exogenous, start, *_ = flights[-1].record
        parts = [part for flight in flights for part in flight.parts]
        like = functools.partial(torch.as_tensor, device=states.device)
        clock = {"start": like(start, dtype=torch.float64), "whole": like(flights[-1].whole)}
        episode["record"] = {"states": states, "actions": actions, "exogenous": exogenous, **clock}
        episode["transitions"] = {str(number): part for number, part in enumerate(parts)}
        return merged(episode, merged(self._report(flights), report))

    def _report(self, flights: Sequence[Flight]) -> TensorDict:
        """The mean cost of flights, their faults, and how often and why they were flown again."""
        costs, last = torch.stack([flight.cost for flight in flights]), flights[-1]
        entries: dict[str, Any] = {"real_cost": costs.mean(), "reward": -costs.mean()}
        if len(flights) > 1:
            entries["largest_cost"] = costs.max()
        if refused := [reason for flight in flights for reason in flight.refused]:
            entries |= {"episodes_refused": float(len(refused)), "refusal": "; ".join(refused)}
        kinds = Counter(fault.kind for fault in self.flights.faults)
        entries |= {f"faults/{kind}": float(count) for kind, count in kinds.items()}
        if last.after[0]:
            entries["ended_after"] = float(len(last.transitions))
        if not all(flight.whole for flight in flights):
            entries["sound_intervals"] = float(sum(len(part) for flight in flights for part in flight.parts))
        if self.supervisor.limits is not None:
            broken = [self.supervisor.limits.broken(flight.record) for flight in flights]
            entries |= {f"violations/{kind}": float(sum(b[kind].sum() for b in broken)) for kind in broken[0]}
        return metrics(**entries)

    def take(self, live: Role, number: int) -> tuple[Sequence[Flight], TensorDict]:
        """One episode of the policy that may act, the live one if it is cleared; and a report of what acted."""
        policy, role, report = self.supervisor.choose(live)
        strength = 0.0 if role == FIRST else self.config.exploration.strength(number)
        flight = self.flights.fly(policy, strength=strength, whole=self.wanting)
        self.keep(flight, role, policy.state_dict())
        acted = policy.report() if isinstance(policy, StateFeedback) else {}
        return [flight], metrics(exploration=strength, live=role, **report, **acted)

    def keep(self, flight: Flight, pilot: Pilot, weights: Mapping[str, Tensor]) -> None:
        """Remember the record of a flight and, if it is one of a whole episode, what it cost."""
        self.short_term.append(flight.record)
        if flight.whole:  # costs of parts cannot be compared with those of episodes
            self.belief.append(flight.record, pilot, flight.cost.item(), weights, flight.commands)

    def fly_first(self, policy: nn.Module) -> Flight:
        """Fly one whole episode without exploration."""
        return self.flights.fly(policy, strength=0.0, whole=True)


class Operate(Interact):
    """Step 1 on a real system that operates on: takes its windows, and hands policies over.

    A window counts as flown by the version that acted in most of it, or the later of two. Windows that the system flew
    under what the training begins with are learned from, and never compared with a policy's predictions.
    """

    @property
    def operation(self) -> Operation:
        """The real system in operation."""
        return cast(Operation, self.flights.env)

    def fly_first(self, policy: nn.Module) -> Flight:
        """One window under what the training begins with, which then acts on until the first policy takes over."""
        self.operation.hand_over(FIRST, policy, strength=0.0)
        return super().fly_first(policy)

    def hand_over(self, live: Role, episode: int) -> None:
        """Hand over what acts now, which :class:`Supervisor` chooses.

        Args:
            live: role that is live.
            episode: number of the learner's episode, from 0.
        """
        policy, name, report = self.supervisor.choose(live)
        strength = 0.0 if name == FIRST else self.config.exploration.strength(episode)
        self.operation.hand_over(name, policy, strength=strength, report=report)

    def take(self, live: Role, number: int) -> tuple[Sequence[Flight], TensorDict]:
        """Take every window that has come in; wait until one is of a policy.

        Args:
            live: role that acts from the first episode on.
            number: number of the learner's episode, from 0; before the first one nothing was handed over.

        Returns:
            The windows, oldest first, their number, and what was measured of the control intervals.
        """
        if number == 0:
            self.hand_over(live, 0)
        flights, policy_flew = list[Flight](), False
        while not policy_flew or self.operation.waiting():
            if flights and flights[-1].whole and self.config.arm != "model_free":
                self.belief.virtual.learn(flights[-1].record)  # step 3 fits the last one
            policy = self.belief.policies["model_free"]  # what the operation has flown already is known from its orders
            flights.append(self.flights.fly(policy, strength=0.0, whole=self.wanting))
            versions, counts = flights[-1].transitions["version"].unique(return_counts=True)
            order = self.operation.orders[int(versions[counts == counts.max()].max())]
            policy_flew |= order.version > 0 or order.name != FIRST
            self.keep(flights[-1], cast(Pilot, order.name), order.weights)
        report = metrics(
            windows=float(len(flights)),
            version=float(order.version),
            exploration=order.strength,
            live=order.name,
            **order.report or {},
            **self.operation.acted or {},
        )
        late = 1e3 * torch.cat([flight.transitions["late"].flatten() for flight in flights])
        if late.any():
            report.update(metrics(late_median=late.quantile(0.5), late_p99=late.quantile(0.99), late_max=late.max()))
        return flights, report
