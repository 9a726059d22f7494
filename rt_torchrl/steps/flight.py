"""A flight on the real system, what of it is sound, and the memory D_S of records."""

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from rt_torchrl.plants.plant import Plant
from rt_torchrl.steps.report import findings
from rt_torchrl.systems.exploration import LivePolicy
from rt_torchrl.systems.operation.operator import Operation
from rt_torchrl.systems.sound_part import (
    SHORTEST,
    EpisodeEndedError,
    Fault,
    SoundPart,
    report_of,
    sound_part,
    tried_in_vain,
)
from rt_torchrl.trajectories.trajectory import Trajectory


class ShortTermMemory(deque[Trajectory]):
    """The records of the last ``capacity`` real episodes, oldest first."""

    def __init__(self, capacity: int):
        if capacity < 1:
            raise ValueError(f"capacity={capacity} of the short-term memory (n_S) must be at least 1.")
        super().__init__(maxlen=capacity)

    def whole(self, n_steps: int, *, latest: int = 0) -> bool:
        """Whether the latest records, or all with 0, are those of whole episodes of ``n_steps`` control intervals."""
        return all(len(record.actions) == n_steps for record in list(self)[-latest:])

    def state_dict(self) -> dict[str, Any]:
        return {"records": [record._asdict() for record in self]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.clear()
        self.extend(Trajectory(**record) for record in state["records"])


LEAST_SOUND = 0.5
"""Least share of a real episode in one sound part, below which it is flown again."""
FLIGHTS = 3
"""Number of real episodes in a row without a sound part after which somebody has to look at the machine."""


class Flight(NamedTuple):
    """A real episode that can be learned from.

    Attributes:
        transitions: the transitions of its longest sound part, whose action is the applied one.
        record: the trajectory of that part; its clock says where it begins.
        refused: why earlier attempts could not be learned from.
        faults: faults of the system in this episode and in the earlier attempts.
        others: transitions of its other sound parts, each with the number of its first interval.
        whole: whether the record is that of a whole episode, to its horizon or to its early end.
        after: number of control intervals after an early end, and what each of them costs, L_e.
    """

    transitions: TensorDict
    record: Trajectory
    refused: Sequence[str] = ()
    faults: Sequence[Fault] = ()
    others: Sequence[tuple[int, TensorDict]] = ()
    whole: bool = True
    after: tuple[int, float] = (0, 0.0)

    @property
    def ended(self) -> bool:
        """Whether the episode has ended early, before the last interval of the horizon."""
        return bool(self.after[0])

    @property
    def cost(self) -> Tensor:
        """J_a as measured, in the sound part and after an early end."""
        rewards, (count, each) = self.transitions["next", "reward"], self.after
        return -(rewards.sum() - count * each) / (len(rewards) + count)

    def parts(self, dt: float) -> list[TensorDict]:
        """The transitions of all sound parts, in their order."""
        first = round(float(self.record.start) / dt)
        return [part for _, part in sorted([(first, self.transitions), *self.others], key=lambda part: part[0])]

    @property
    def sound_intervals(self) -> int:
        """Number of control intervals that are learned from."""
        return sum(map(len, (self.transitions, *(part for _, part in self.others))))

    def report(self) -> TensorDict:
        """The cost, the faults, and how often and why the episode was flown again."""
        found = findings(real_cost=self.cost, reward=-self.cost)
        if self.refused:
            found.update(findings(episodes_refused=float(len(self.refused))))
            found.set_non_tensor("refusal", "; ".join(self.refused))
        if self.faults:
            counts = {fault.kind: 0.0 for fault in self.faults}
            for fault in self.faults:
                counts[fault.kind] += 1.0
            found.update(findings(**{f"faults/{kind}": count for kind, count in counts.items()}))
        if self.ended:
            found.update(findings(ended_after=float(len(self.transitions))))
        if not self.whole:
            found.update(findings(sound_intervals=float(self.sound_intervals)))
        return found


def together(flights: Sequence[Flight]) -> TensorDict:
    """The report of the flights of one episode of the algorithm, with the faults of all of them."""
    refused, faults = ([each for flight in flights for each in getattr(flight, name)] for name in ("refused", "faults"))
    report = flights[-1]._replace(refused=refused, faults=faults).report()
    if not all(flight.whole for flight in flights):
        report.update(findings(sound_intervals=float(sum(flight.sound_intervals for flight in flights))))
    return report


def flown(flights: Sequence[Flight], dt: float) -> TensorDict:
    """The record of the last of some flights, and the transitions of all their sound parts."""
    last = flights[-1]
    record = last.record
    flag = partial(torch.tensor, device=record.states.device)
    parts = [part for flight in flights for part in flight.parts(dt)]
    return TensorDict(
        {
            "record": {
                "states": record.states,
                "actions": record.actions,
                "exogenous": record.exogenous,
                "start": torch.as_tensor(record.start, dtype=torch.float64, device=record.states.device),
                "whole": flag(last.whole),
                "ended": flag(last.ended),
            },
            "transitions": {str(number): part for number, part in enumerate(parts)},
        }
    )


def record_of(episode: TensorDictBase) -> Trajectory:
    """The record of an episode as a trajectory."""
    record = episode["record"]
    return Trajectory(record["states"], record["actions"], record["exogenous"], float(record["start"]))


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
        """Faults of the system in the episodes since :meth:`begin`."""
        self.latest: Flight | None = None
        """The flight that was flown last."""
        self.check: Callable[[Trajectory], None] | None = None
        """What looks at the record of the first flight, before anything is learned from it, and may raise."""

    def begin(self) -> None:
        """Begin an episode of the algorithm."""
        self.faults = []

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
            episode, found, cause = self._attempt()
            faults += found.faults
            self.faults += found.faults
            first, last = found.longest
            if episode is not None and (found.whole or (not whole and last - first >= self._least)):
                break
            refused.append(found.reason)
            if len(refused) == FLIGHTS:
                raise ValueError(tried_in_vain(refused)) from cause
        others = [(part[0], _transitions(episode, part)) for part in found.parts if part != (first, last)]
        transitions = _transitions(episode, (first, last))
        states = torch.cat([transitions["state"], transitions["next", "state"][-1:]])
        start = first * self.plant.dt
        record = Trajectory(states, transitions["action"], transitions["exogenous"], start)
        after = (self.plant.n_steps - len(episode), self.plant.end_cost or 0.0) if found.whole else (0, 0.0)
        self.latest = Flight(transitions, record, refused, faults, others, found.whole, after)
        if self.check is not None:
            check, self.check = self.check, None
            check(record)
        return self.latest

    def fly_first(self, policy: nn.Module) -> Flight:
        """Fly one whole episode without exploration."""
        return self.fly(policy, strength=0.0, whole=True)

    def _attempt(self) -> tuple[TensorDictBase | None, SoundPart, Exception | None]:
        """One episode, its sound part, and the error that ended it."""
        try:
            episode, ended = self.rollout()[0], None
        except EpisodeEndedError as error:
            ended, flown = error, error.flown
            if flown is None:
                fault = Fault("ended", 0, 0.0, str(error))
                return None, SoundPart([], [fault], str(error), whole=False), error
            episode = flown[0]
        report = self.env.report if isinstance(self.env, Operation) else report_of(self.env)
        found = sound_part(episode, self.plant, report)
        if ended is None:
            return episode, found, None
        n = len(episode)
        fault = Fault("ended", n, n * self.plant.dt, str(ended))
        reason = "; ".join(part for part in (found.reason, str(ended)) if part)
        return episode, found._replace(faults=[*found.faults, fault], reason=reason, whole=False), ended


def _transitions(episode: TensorDictBase, part: tuple[int, int]) -> TensorDict:
    """The transitions of a part of an episode; the last one is truncated, unless the episode ends there early."""
    first, last = part
    found = episode[first:last].clone() if last - first < len(episode) else episode
    # The learner learns from the action that was applied.
    found["action"] = found["next", "applied"]
    found["next", "done"][-1] = True
    found["next", "truncated"][-1] = ~found["next", "terminated"][-1]
    return found
