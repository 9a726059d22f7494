"""Step 1: one episode on the real system, what of it is sound, and which policy may act."""

import copy
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from rt_torchrl.plants.plant import Plant
from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import Role, TwinningConfig
from rt_torchrl.steps.report import Step, in_words, merged, metrics, plain
from rt_torchrl.systems.config import OperatingLimitsConfig
from rt_torchrl.systems.exploration import LivePolicy
from rt_torchrl.systems.operation import FIRST, Operation, Order
from rt_torchrl.systems.safety import OperatingLimits, require_layer
from rt_torchrl.systems.sound_part import (
    FLIGHTS,
    EpisodeEndedError,
    Fault,
    SoundPart,
    report_of,
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
TWICE = 2.0
"""Cost that is expected of a policy over that of the controller that flew first, beyond which the policy is not tried.

A policy that costs less shows how the real system answers other actions, without which plans do not improve."""


class Flight(NamedTuple):
    """A real episode that can be learned from.

    Attributes:
        transitions: the transitions of its longest sound part, whose action is the applied one.
        record: the trajectory of that part; its clock says where it begins.
        parts: the transitions of all sound parts, in their order.
        refused: why earlier attempts could not be learned from.
        faults: faults of the system in this episode and in the earlier attempts.
        whole: whether the record is that of a whole episode, to its horizon or to its early end.
        after: number of control intervals after an early end, and what each of them costs, L_e.
        commands: the commands of the record's intervals, before safety layers and actuators.
    """

    transitions: TensorDict
    record: Trajectory
    parts: Sequence[TensorDict]
    refused: Sequence[str] = ()
    faults: Sequence[Fault] = ()
    whole: bool = True
    after: tuple[int, float] = (0, 0.0)
    commands: Tensor | None = None

    @property
    def ended(self) -> bool:
        """Whether the episode has ended early, before the last interval of the horizon."""
        return bool(self.after[0])

    @property
    def cost(self) -> Tensor:
        """J_a as measured, in the sound part and after an early end."""
        rewards, (count, end_cost) = self.transitions["next", "reward"], self.after
        return -(rewards.sum() - count * end_cost) / (len(rewards) + count)


def report_of_flights(flights: Sequence[Flight]) -> TensorDict:
    """The cost of the last of some flights, the faults of all, and how often and why they were flown again."""
    last = flights[-1]
    report = metrics(real_cost=last.cost, reward=-last.cost)
    refused = [reason for flight in flights for reason in flight.refused]
    if refused:
        report.update(metrics(episodes_refused=float(len(refused)), refusal="; ".join(refused)))
    kinds = Counter(fault.kind for flight in flights for fault in flight.faults)
    report.update(metrics(**{f"faults/{kind}": float(count) for kind, count in kinds.items()}))
    if last.ended:
        report.update(metrics(ended_after=float(len(last.transitions))))
    if not all(flight.whole for flight in flights):
        report.update(metrics(sound_intervals=float(sum(len(part) for flight in flights for part in flight.parts))))
    return report


def flown(flights: Sequence[Flight]) -> TensorDict:
    """The record of the last of some flights, and the transitions of all their sound parts."""
    last = flights[-1]
    record = last.record
    parts = [part for flight in flights for part in flight.parts]
    return TensorDict(
        {
            "record": {
                "states": record.states,
                "actions": record.actions,
                "exogenous": record.exogenous,
                "start": torch.as_tensor(record.start, dtype=torch.float64, device=record.states.device),
                "whole": torch.tensor(last.whole, device=record.states.device),
            },
            "transitions": {str(number): part for number, part in enumerate(parts)},
        }
    )


class RealFlights:
    """Real episodes of the algorithm: each is flown, and flown again if too little of it is sound.

    Args:
        env: the real system, or an operation of one.
        actor: what acts in the rollout.
        rollout: function that flies one episode of batch size 1.
        plant: plant that gives the length of an episode.
    """

    def __init__(
        self,
        env: EnvBase | Operation,
        actor: LivePolicy,
        rollout: Callable[[], TensorDict],
        plant: Plant,
    ):
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
        faults: list[Fault] = []
        while True:
            self.actor.begin(policy, strength=strength)
            episode, sound, cause = self._attempt()
            faults += sound.faults
            self.faults += sound.faults
            first, last = sound.longest
            if episode is not None and (sound.whole or (not whole and last - first >= self._least)):
                break
            refused.append(sound.reason)
            if len(refused) == FLIGHTS:
                raise ValueError(tried_in_vain(refused)) from cause
        commands = episode["action"][first:last].clone()
        parts = [_transitions(episode, part) for part in sound.parts]
        transitions, record = parts[sound.parts.index((first, last))], self._record(episode, (first, last))
        after = (self.plant.n_steps - len(episode), self.plant.end_cost or 0.0) if sound.whole else (0, 0.0)
        if self.check is not None:
            check, self.check = self.check, None
            check(record)
        return Flight(transitions, record, parts, refused, faults, sound.whole, after, commands)

    def _record(self, episode: TensorDictBase, part: tuple[int, int]) -> Trajectory:
        """The trajectory of a part of an episode, with the actions that were applied."""
        first, last = part
        flown = episode[first:last]
        states = torch.cat([flown["state"], flown["next", "state"][-1:]])
        return Trajectory(states, flown["next", "applied"], flown["exogenous"], first * self.plant.dt)

    def fly_first(self, policy: nn.Module) -> Flight:
        """Fly one whole episode without exploration."""
        return self.fly(policy, strength=0.0, whole=True)

    def _attempt(self) -> tuple[TensorDictBase | None, SoundPart, Exception | None]:
        """One episode, its sound part, and the error that ended it."""
        try:
            episode, failure = self.rollout()[0], None
        except EpisodeEndedError as error:
            failure, flown = error, error.flown
            if flown is None:
                fault = Fault("ended", 0, 0.0, str(error))
                return None, SoundPart([], [fault], str(error), whole=False), error
            episode = flown[0]
        report = self.env.report if isinstance(self.env, Operation) else report_of(self.env)
        sound = sound_part(episode, self.plant, report)
        if failure is None:
            return episode, sound, None
        n = len(episode)
        fault = Fault("ended", n, n * self.plant.dt, str(failure))
        reason = "; ".join(part for part in (sound.reason, str(failure)) if part)
        return episode, sound._replace(faults=[*sound.faults, fault], reason=reason, whole=False), failure


def _transitions(episode: TensorDictBase, part: tuple[int, int]) -> TensorDict:
    """The transitions of a part of an episode; the last one is truncated, unless the episode ends there early."""
    first, last = part
    transitions = episode[first:last].clone() if last - first < len(episode) else episode
    # The learner learns from the action that was applied.
    transitions["action"] = transitions["next", "applied"]
    transitions["next", "done"][-1] = True
    transitions["next", "truncated"][-1] = ~transitions["next", "terminated"][-1]
    return transitions


class Choice(NamedTuple):
    """What may act, the role whose weights it has or ``first``, and the report of the check."""

    policy: nn.Module
    role: str
    report: TensorDict


class Supervisor:
    """Lets a policy act only if it is expected to keep the limits, and not to cost twice what flew first.

    The live policy is asked first, then the idle one. Where neither may act, the weights do that were cleared for the
    limits last, or without these the controller with which the training has begun. Before the first real episode
    nothing is known, and the live policy acts unchecked, behind the safety layer.

    Args:
        env: the real system, which needs a safety layer if there are limits.
        policies: the policies that are trained, by role.
        belief: what policies cost, and the virtual episodes.
        config: the limits.
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
        controller: nn.Module | None = None,
    ):
        self.limited = bool(config)
        if self.limited:
            require_layer(env)
        self.policies, self.belief, self.virtual = policies, belief, belief.virtual
        self.limits, self.controller = OperatingLimits(belief.virtual.twin.plant, config), controller
        self._last: dict[str, Any] | None = None
        """The role and weights that were cleared last."""

    @torch.no_grad()
    def choose(self, live: Role, count: int) -> Choice:
        """What may act.

        Args:
            live: role that the referee wants to act.
            count: number of virtual episodes of the check.

        Returns:
            What may act. The report holds a reason for each policy that is refused and, of a policy with limits,
            ``predicted_violations``, the share of control intervals beyond one.

        Raises:
            ValueError: if nothing may act.
        """
        episodes, refused = self.episodes(count), list[str]()
        for role in sorted(self.policies, key=lambda role: role != live):  # the live one first
            policy = self.policies[role]
            reason, share = self.refusal(role, episodes)
            if reason:
                refused.append(reason)
            elif episodes is None:
                return Choice(policy, role, metrics(*refused))
            else:
                self._last = {"role": role, "weights": copy.deepcopy(policy.state_dict())}
                return Choice(policy, role, metrics(*refused, predicted_violations=share))
        if self._last is not None and episodes is not None:
            role, policy = self._last["role"], copy.deepcopy(self.policies[self._last["role"]])
            policy.load_state_dict(self._last["weights"])
            share = self.predicted(policy, episodes)
            return Choice(policy, role, metrics(*refused, predicted_violations=share))
        if self.controller is not None:
            return Choice(self.controller, FIRST, metrics(*refused))
        raise ValueError(
            f"no policy may act. {'; '.join(refused)}. Widen the limits, or begin with something that keeps them, such "
            "as --start controller."
        )

    def episodes(self, count: int) -> Scenario | None:
        """Virtual episodes in which the limits are checked; None without limits, and before anything is known."""
        return self.virtual.draw(count) if self.limited and self.virtual.processes else None

    @torch.no_grad()
    def refusal(self, role: Role, episodes: Scenario | None) -> tuple[str, float]:
        """Why a policy may not act, empty if it may, and the share of control intervals beyond a limit.

        Args:
            role: role of the policy.
            episodes: see :meth:`episodes`.
        """
        policy = self.policies[role]
        share = 0.0 if episodes is None else self.predicted(policy, episodes)
        if share > 0.0:
            return f"{role} may not act: it would leave the limits in {100 * share:.3g} % of the intervals", share
        known = self.belief.beside_first(policy, self.controller)
        if known is None or known[0] <= TWICE * known[1]:
            return "", share
        expected, paid = map(in_words, known)
        where = f"where the controller that flew first cost {paid}"
        return f"{role} may not act: it is expected to cost {expected} {where}", share

    def predicted(self, policy: nn.Module, episodes: Scenario) -> float:
        """The share of control intervals of virtual episodes beyond any limit; 1 if the twin diverges."""
        try:
            flown = self.virtual.twin.control(policy, *episodes)
        except DivergenceError:
            return 1.0
        broken = self.limits.broken(flown)
        return torch.stack(list(broken.values())).any(0).double().mean().item()

    def counted(self, flown: Trajectory) -> TensorDict:
        """Numbers of control intervals of a real episode beyond each kind of limits."""
        broken = self.limits.broken(flown)
        return metrics(**{f"violations/{kind}": intervals.sum().double() for kind, intervals in broken.items()})

    def state_dict(self) -> dict[str, Any]:
        return {"last": self._last}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._last = state["last"]


class Operating:
    """Takes the windows of an operation, and hands policies over.

    A window counts as flown by the version that acted in most of it, or the later of two. Windows that the system flew
    under what the training begins with are learned from, and never compared with a policy's predictions.

    Args:
        operation: the real system in operation.
        step: step 1, with what it shares with the other steps.
    """

    def __init__(self, operation: Operation, step: "Interact"):
        self.operation, self.step, self._exploration = operation, step, step.config.exploration

    def fly_first(self, teacher: nn.Module) -> Flight:
        """One window under what the training begins with, which then acts on until the first policy takes over."""
        self.operation.hand_over(FIRST, teacher, strength=0.0)
        return self.step.flights.fly_first(teacher)

    def hand_over(self, role: Role, episode: int) -> None:
        """Hand over what acts now, which :class:`Supervisor` chooses.

        Args:
            role: role that is live.
            episode: number of the learner's episode, from 0.
        """
        policy, name, report = self.step.supervisor.choose(role, self.step.judged)
        strength = 0.0 if name == FIRST else self._exploration.strength(episode)
        self.operation.hand_over(name, policy, strength=strength, report=plain(report))

    def take(self, live: Role, episode: int) -> tuple[Sequence[Flight], TensorDict]:
        """Take every window that has come in; wait until one is of a policy.

        Args:
            live: role that acts from the first episode on.
            episode: number of the learner's episode, from 0; before the first one nothing was handed over.

        Returns:
            The windows, oldest first; ``real_cost``, the mean J_a of the ``windows``, and what was measured of the
            control intervals.
        """
        if episode == 0:
            self.hand_over(live, 0)
        flights, policy_flew = list[Flight](), False
        while not policy_flew or self.operation.waiting():
            if flights and flights[-1].whole and self.step.config.arm != "model_free":
                self.step.virtual.learn(flights[-1].record)  # step 3 fits the last one
            flight = self.step.flights.fly(self.step.policies["model_free"], strength=0.0, whole=self.step.wanting)
            flights.append(flight)
            order = self._order_of(flight)
            policy_flew |= order.version > 0 or order.name != FIRST
            self.step.keep(flight, order.name, order.weights)
        return flights, self._report(flights)

    def _order_of(self, flight: Flight) -> Order:
        versions = flight.transitions["version"].flatten()
        numbers, counts = versions.unique(return_counts=True)
        return self.operation.orders[int(numbers[counts == counts.max()].max())]

    def _report(self, flights: list[Flight]) -> TensorDict:
        order = self._order_of(flights[-1])
        cost = torch.stack([flight.cost for flight in flights]).mean()
        report = report_of_flights(flights).update(metrics(real_cost=cost, reward=-cost, exploration=order.strength))
        report.update(metrics(windows=float(len(flights)), version=float(order.version)))
        merged(report, metrics(**(order.report or {}))).update(metrics(**(self.operation.acted or {})))
        if self.step.supervisor.limited:
            counted = [self.step.supervisor.counted(flight.record) for flight in flights]
            kinds = counted[0].keys()
            report.update(metrics(**{kind: sum(float(violations[kind]) for violations in counted) for kind in kinds}))
        late = torch.cat([flight.transitions["late"].flatten() for flight in flights])
        if late.any():
            period = 1e3 * late
            report.update(metrics(late_median=period.median(), late_p99=period.quantile(0.99), late_max=period.max()))
        return report.set_non_tensor("live", order.name)


class Interact(Step):
    """Step 1: the live policy flies one episode on the real system, or acts in a window of one that operates on.

    Reads ``number``, that of the episode from 0, and ``live``, the role that acts. Writes ``record``, the trajectory of
    the sound part (``states`` n+1 × n_s, ``actions`` n × n_a, ``exogenous`` n × n_z, ``start`` [s], and whether it is
    that of a ``whole`` episode, to its horizon or to its early end), ``transitions`` of all sound parts, by number, as
    TorchRL's collectors give them, and ``real_cost``, J_a as measured.

    Args:
        env: the real system, or an operation of one.
        policies: both policies by role.
        flights: real episodes of the system.
        supervisor: which policy may act.
        belief: what takes the costs of whole episodes, and has the virtual episodes.
        config: hyper-parameters.
        judged: number of virtual episodes on which policies are judged.
    """

    in_keys = ["number", "live"]
    out_keys = ["record", "transitions", "real_cost", "live"]

    def __init__(
        self,
        env: EnvBase | Operation,
        policies: dict[Role, nn.Module],
        flights: RealFlights,
        supervisor: Supervisor,
        belief: Belief,
        config: TwinningConfig,
        judged: int,
    ):
        short_term = ShortTermMemory(maxlen=config.records)
        super().__init__(env=env, supervisor=supervisor, short_term=short_term)
        self.short_term, self.policies, self.flights = short_term, policies, flights
        self.supervisor, self.belief, self.virtual = supervisor, belief, belief.virtual
        self.config, self.judged = config, judged
        self.operating = Operating(env, self) if isinstance(env, Operation) else None

    @property
    def wanting(self) -> bool:
        """Whether a twin still needs the inputs of one whole real episode."""
        return self.config.arm != "model_free" and not self.virtual.processes

    def forward(self, episode: TensorDictBase) -> TensorDictBase:
        live, number = episode["live"], int(episode["number"])
        flights, report = (self.operating or self).take(live, number)
        return merged(episode.update(flown(flights)), report)

    def take(self, live: Role, number: int) -> tuple[Sequence[Flight], TensorDict]:
        """One episode of the policy that may act, the live one if it is cleared."""
        choice = self.supervisor.choose(live, self.judged)
        acting, strength = choice.policy, 0.0 if choice.role == FIRST else self.config.exploration.strength(number)
        flight = self.flights.fly(acting, strength=strength, whole=self.wanting)
        self.keep(flight, choice.role, acting.state_dict())
        report = merged(report_of_flights([flight]), metrics(exploration=self.flights.actor.strength))
        report = merged(report, choice.report)
        if self.supervisor.limited:
            report.update(self.supervisor.counted(flight.record))
        report.update(metrics(**acting.report()) if isinstance(acting, StateFeedback) else {})
        return [flight], report.set_non_tensor("live", choice.role)

    def keep(self, flight: Flight, pilot: str, weights: Mapping[str, Tensor]) -> None:
        """Remember the record of a flight and, if it is one of a whole episode, what it cost."""
        self.short_term.append(flight.record)
        if not flight.whole:  # costs of parts cannot be compared with those of episodes
            return
        if pilot == FIRST:
            self.belief.append_first(flight.record, flight.cost.item())
        else:
            self.belief.append(flight.record, cast(Role, pilot), flight.cost.item(), weights, flight.commands)
