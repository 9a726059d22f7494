"""Step 1: one episode on the real system, what of it is sound, and which policy may act."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import ROLES, Role, TwinningConfig
from rt_torchrl.steps.flight import Flight, RealFlights, ShortTermMemory, flown, together
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.report import Step, as_findings, findings, merged, plain
from rt_torchrl.systems.config import OperatingLimitsConfig
from rt_torchrl.systems.operation.operator import FIRST, Operation, Order
from rt_torchrl.systems.safety import OperatingLimits, require_layer
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory


class Cleared(NamedTuple):
    """The policy that may act, the role whose weights it has, and the report of the check."""

    policy: nn.Module
    role: Role
    report: TensorDict


class Clearance:
    """Lets a policy act only if the twin predicts that it keeps the limits.

    The live policy is asked first, then the idle one, then the weights that were cleared last. Before the first real
    episode there are no virtual episodes, and the live policy acts unchecked, behind the safety layer.

    Args:
        env: the real system, which needs a safety layer if there are limits.
        policies: both policies by role.
        virtual: virtual episodes.
        config: the limits.

    Raises:
        ValueError: if the plant has no such limits, see :class:`OperatingLimits`, or the real system no safety layer.
    """

    def __init__(
        self, env: EnvBase, policies: Mapping[Role, nn.Module], virtual: VirtualEpisodes, config: OperatingLimitsConfig
    ):
        if config:
            require_layer(env)
        self.policies, self.virtual, self.config = policies, virtual, config
        self.limits = OperatingLimits(virtual.twin.plant, config)
        self._last: tuple[Role, dict[str, Tensor]] | None = None

    @torch.no_grad()
    def choose(self, live: Role, count: int) -> Cleared:
        """The policy that may act.

        Args:
            live: role that the referee wants to act.
            count: number of virtual episodes of the check.

        Returns:
            The policy. The report holds ``predicted_violations``, its share of control intervals beyond a limit, and a
            reason for each policy that is refused.

        Raises:
            ValueError: if no policy may act.
        """
        if not self.config or not self.virtual.processes:
            return Cleared(self.policies[live], live, findings())
        episodes, reasons = self.virtual.draw(count), list[str]()
        for role in (live, *(other for other in ROLES if other != live)):
            share = self.predicted(self.policies[role], episodes)
            if share <= self.config.tolerated:
                self._last = role, copy.deepcopy(self.policies[role].state_dict())
                return Cleared(self.policies[role], role, findings(*reasons, predicted_violations=share))
            reasons.append(f"{role} may not act: it would leave the limits in {100.0 * share:.3g} % of the intervals")
        if self._last is None:
            raise ValueError(
                f"no policy may act. {'; '.join(reasons)}; limits.tolerated={self.config.tolerated}. Widen the limits "
                "or raise that share, or begin with something that keeps the limits, such as --start controller."
            )
        role, weights = self._last
        policy = copy.deepcopy(self.policies[role])
        policy.load_state_dict(weights)
        return Cleared(policy, role, findings(*reasons, predicted_violations=self.predicted(policy, episodes)))

    def predicted(self, policy: nn.Module, episodes: Scenario) -> float:
        """The share of control intervals of virtual episodes beyond any limit; 1 if the twin diverges."""
        try:
            flown = self.virtual.twin.control(policy, *episodes)
        except DivergenceError:
            return 1.0
        broken = self.limits.broken(flown)
        return torch.stack(list(broken.values())).any(0).double().mean().item()

    def counted(self, flown: Trajectory) -> TensorDict:
        """Numbers of control intervals of a real episode beyond each kind of limits; nothing without limits."""
        if not self.config:
            return findings()
        broken = self.limits.broken(flown)
        return findings(**{f"violations/{kind}": found.sum().double() for kind, found in broken.items()})

    def state_dict(self) -> dict[str, Any]:
        """The role and weights that were cleared last."""
        return {"last": None if self._last is None else {"role": self._last[0], "weights": self._last[1]}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        last = state["last"]
        self._last = None if last is None else (last["role"], last["weights"])


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
        """Hand over the policy that acts now, or another one if the twin predicts that it would leave the limits.

        Args:
            role: role that is live.
            episode: number of the learner's episode, from 0.
        """
        policy, role, report = self.step.clearance.choose(role, self.step.judged)
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
            if flights and flights[-1].whole and self.step.config.arm != "model_free":
                self.step.virtual.learn(flights[-1].record)  # step 3 fits the last one
            flight = self._taken()
            self.step.short_term.append(flight.record)
            flights.append(flight)
            order = self._order_of(flight)
            if order.name != FIRST:
                policy_flew = True
                self._note(flight, order)
        return flights, self._report(flights)

    def _taken(self) -> Flight:
        needed = self.step.virtual.wanting(self.step.config.arm)
        return self.step.flights.fly(self.step.policies["model_free"], strength=0.0, whole=needed)

    def _order_of(self, flight: Flight) -> Order:
        versions = flight.transitions["version"].flatten()
        found, counts = versions.unique(return_counts=True)
        return self.operation.orders[int(found[counts == counts.max()].max())]

    def _note(self, flight: Flight, order: Order) -> None:
        if not flight.whole:
            return  # costs of parts cannot be compared with those of windows
        role, cost = cast(Role, order.name), flight.cost.item()
        explored = order.strength * self._exploration.spread
        self.step.belief.append(flight.record, role, cost, explored, order.weights)

    def _report(self, flights: list[Flight]) -> TensorDict:
        order = self._order_of(flights[-1])
        cost = torch.stack([flight.cost for flight in flights]).mean()
        report = together(flights).update(findings(real_cost=cost, reward=-cost, exploration=order.strength))
        report.update(findings(windows=float(len(flights)), version=float(order.version)))
        merged(report, as_findings(order.found or {})).update(findings(**(self.operation.acted or {})))
        counted = [self.step.clearance.counted(flight.record) for flight in flights]
        kinds = counted[0].keys()
        report.update(findings(**{kind: sum(float(each[kind]) for each in counted) for kind in kinds}))
        late = torch.cat([flight.transitions["late"].flatten() for flight in flights])
        if late.any():
            period = 1e3 * late
            report.update(findings(late_median=period.median(), late_p99=period.quantile(0.99), late_max=period.max()))
        return report.set_non_tensor("live", order.name)


class Interact(Step):
    """Step 1: the live policy flies one episode on the real system, or acts in a window of one that operates on.

    Reads ``number``, that of the episode from 0, and ``live``, the role that acts. Writes ``record``, the trajectory of
    the sound part (``states`` n+1 × n_s, ``actions`` n × n_a, ``exogenous`` n × n_z, ``start`` [s]; whether it is that
    of a ``whole`` episode, and whether this ``ended`` early), ``transitions`` of all sound parts, by number, as
    TorchRL's collectors give them, and ``real_cost``, J_a as measured.

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
        short_term = ShortTermMemory(config.records)
        super().__init__(env=env, clearance=clearance, short_term=short_term)
        self.short_term, self.policies, self.flights = short_term, policies, flights
        self.clearance, self.belief = clearance, belief
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
