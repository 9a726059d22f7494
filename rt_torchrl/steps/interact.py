"""Step 1: one episode on the real system, and what of it is learned from."""

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import Role
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.report import Step, findings, merged
from rt_torchrl.systems.operation.operation import Operation
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.twinning.clearance import Clearance
from rt_torchrl.twinning.config import TwinningConfig
from rt_torchrl.twinning.flight import Flight, RealFlights
from rt_torchrl.twinning.operating import Operating
from rt_torchrl.twinning.short_term_memory import ShortTermMemory


class Interact(Step):
    """Step 1: the live policy flies one episode on the real system, or acts in a window of one that operates on.

    Reads ``number``, that of the episode from 0, and ``live``, the role that acts. Writes ``record``, the trajectory of
    the sound part (``states`` n+1 × n_s, ``actions`` n × n_a, ``exogenous`` n × n_z, ``start`` [s]), ``transitions``
    of all sound parts, by number, as TorchRL's collectors give them, and ``real_cost``, J_a as measured.

    Args:
        env: the real system, or an operation of one.
        policies: both policies by role.
        flights: real episodes of the system.
        clearance: which policy may act.
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
        clearance: Clearance,
        belief: Belief,
        config: TwinningConfig,
        judged: int,
    ):
        self.short_term = ShortTermMemory(config.records)
        super().__init__(env=env, clearance=clearance, short_term=self.short_term)
        self.policies, self.flights, self.clearance, self.belief = policies, flights, clearance, belief
        self.config, self.judged = config, judged
        self.operating = Operating(env, self) if isinstance(env, Operation) else None

    @property
    def virtual(self) -> VirtualEpisodes:
        """Virtual episodes of the twin."""
        return self.belief.virtual

    def forward(self, episode: TensorDictBase) -> TensorDictBase:
        self.flights.begin()
        live, number = episode["live"], int(episode["number"])
        flights, report = (self.operating or self).take(live, number)
        return merged(episode.update(flown(flights, self.virtual.twin.plant.dt)), report)

    def take(self, live: Role, number: int) -> tuple[Sequence[Flight], TensorDict]:
        """One episode of the policy that may act, the live one if it is cleared."""
        cleared = self.clearance.choose(live, self.judged)
        acting, strength = cleared.policy, self.config.exploration.strength(number)
        flight = self.flights.fly(acting, strength=strength, whole=self.virtual.wanting(self.config.arm))
        self.short_term.append(flight.record)
        explored = self.flights.actor.strength * self.config.exploration.spread
        if flight.whole:  # costs of parts cannot be compared with those of episodes
            self.belief.append(flight.record, cleared.role, flight.cost.item(), explored, acting.state_dict())
        report = merged(flight.report(), findings(exploration=self.flights.actor.strength))
        report = merged(merged(report, cleared.report), self.clearance.counted(flight.record))
        report.update(findings(**acting.report()) if isinstance(acting, StateFeedback) else {})
        return [flight], report.set_non_tensor("live", cleared.role)


def flown(flights: Sequence[Flight], dt: float) -> TensorDict:
    """The record of the last of some flights, and the transitions of all their sound parts."""
    record = flights[-1].record
    parts = [part for flight in flights for part in flight.parts(dt)]
    return TensorDict(
        {
            "record": {
                "states": record.states,
                "actions": record.actions,
                "exogenous": record.exogenous,
                "start": torch.as_tensor(record.start, dtype=torch.float64),
            },
            "transitions": {str(number): part for number, part in enumerate(parts)},
        }
    )


def record_of(episode: TensorDictBase) -> Trajectory:
    """The record of an episode as a trajectory."""
    record = episode["record"]
    return Trajectory(record["states"], record["actions"], record["exogenous"], float(record["start"]))
