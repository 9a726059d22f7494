"""Step 1 where the real system operates on while the algorithm learns."""

from collections.abc import Sequence
from typing import Protocol, cast, runtime_checkable

import torch
from tensordict import TensorDict
from torch import nn

from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import Role
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.report import as_findings, findings, merged, plain
from rt_torchrl.systems.operation.operation import Operation
from rt_torchrl.systems.operation.order import FIRST, Order
from rt_torchrl.twinning.clearance import Clearance
from rt_torchrl.twinning.config import TwinningConfig
from rt_torchrl.twinning.flight import Flight, RealFlights, together
from rt_torchrl.twinning.short_term_memory import ShortTermMemory


@runtime_checkable
class Trainer(Protocol):
    """What :class:`Operating` needs of the algorithm."""

    policies: dict[Role, nn.Module]
    clearance: Clearance
    flights: RealFlights
    config: TwinningConfig
    belief: Belief
    short_term: ShortTermMemory
    judged: int

    @property
    def virtual(self) -> VirtualEpisodes:
        """Virtual episodes of the twin."""


class Operating:
    """Takes the windows of an operation, and hands policies over.

    A window counts as flown by the version that acted in most of it, or the later of two. Windows that the system flew
    under what the training begins with are learned from, and never compared with a policy's predictions.

    Args:
        operation: the real system in operation.
        trainer: the algorithm.
    """

    def __init__(self, operation: Operation, trainer: Trainer):
        self.operation, self.trainer, self._exploration = operation, trainer, trainer.config.exploration

    def fly_first(self, teacher: nn.Module) -> Flight:
        """One window under what the training begins with, which then acts on until the first policy takes over."""
        self.operation.hand_over(FIRST, teacher, strength=0.0)
        return self.trainer.flights.fly_first(teacher)

    def hand_over(self, role: Role, episode: int) -> None:
        """Hand over the policy that acts now, or another one if the twin predicts that it would leave the limits.

        Args:
            role: role that is live.
            episode: number of the learner's episode, from 0.
        """
        policy, role, report = self.trainer.clearance.choose(role, self.trainer.judged)
        strength = self._exploration.strength(episode)
        self.operation.hand_over(role, policy, strength=strength, found=plain(report))

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
            if flights and flights[-1].whole and self.trainer.config.arm != "model_free":
                self.trainer.virtual.learn(flights[-1].record)  # step 3 fits the last one
            flight = self._taken()
            self.trainer.short_term.append(flight.record)
            flights.append(flight)
            order = self._order_of(flight)
            if order.name != FIRST:
                policy_flew = True
                self._note(flight, order)
        return flights, self._report(flights)

    def _taken(self) -> Flight:
        needed = self.trainer.virtual.wanting(self.trainer.config.arm)
        return self.trainer.flights.fly(self.trainer.policies["model_free"], strength=0.0, whole=needed)

    def _order_of(self, flight: Flight) -> Order:
        versions = flight.transitions["version"].flatten()
        found, counts = versions.unique(return_counts=True)
        return self.operation.orders[int(found[counts == counts.max()].max())]

    def _note(self, flight: Flight, order: Order) -> None:
        if not flight.whole:
            return  # costs of parts cannot be compared with those of windows
        role, cost = cast(Role, order.name), flight.cost.item()
        explored = order.strength * self._exploration.spread
        self.trainer.belief.append(flight.record, role, cost, explored, order.weights)

    def _report(self, flights: list[Flight]) -> TensorDict:
        order = self._order_of(flights[-1])
        cost = torch.stack([flight.cost for flight in flights]).mean()
        report = together(flights).update(findings(real_cost=cost, reward=-cost, exploration=order.strength))
        report.update(findings(windows=float(len(flights)), version=float(order.version)))
        merged(report, as_findings(order.found or {})).update(findings(**(self.operation.acted or {})))
        counted = [self.trainer.clearance.counted(flight.record) for flight in flights]
        kinds = counted[0].keys()
        report.update(findings(**{kind: sum(float(each[kind]) for each in counted) for kind in kinds}))
        late = torch.cat([flight.transitions["late"].flatten() for flight in flights])
        if late.any():
            period = 1e3 * late
            report.update(findings(late_median=period.median(), late_p99=period.quantile(0.99), late_max=period.max()))
        return report.set_non_tensor("live", order.name)
