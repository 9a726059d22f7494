"""The acting side of an operation: control intervals of a real system, in windows of the length of an episode.

A system in operation acts on while the algorithm learns; docs/connect_your_machine.md explains it.
"""

import copy
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from rt_torchrl.plants.plant import Plant
from rt_torchrl.systems.collectors import failure, pass_over
from rt_torchrl.systems.config import OperationConfig
from rt_torchrl.systems.environment import PlantEnv, ended_early, innermost
from rt_torchrl.systems.exploration import BumplessPolicy, ExplorationConfig
from rt_torchrl.systems.safety import SafetyReport
from rt_torchrl.systems.sound_part import EpisodeEndedError, report_of
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback

FIRST = "first"
"""Name of the policy or state feedback that acts before the trained policies do."""
HANDOVER = 20
"""Number of control intervals in which an offset of a handover as wide as the range of the action fades."""


class Order(NamedTuple):
    """A policy that is to take over at once, as it was when the order was given.

    Attributes:
        version: number of the order, from 0; each interval of a record names the version that acted in it.
        name: name of the policy, such as its role.
        weights: its weights.
        strength: strength ξ of the exploration.
        found: what was found about the policy before, such as ``predicted_violations``, by name.
    """

    version: int
    name: str
    weights: dict[str, Tensor]
    strength: float
    found: dict[str, float | str] | None = None

    def ready(self, policies: Mapping[str, nn.Module]) -> nn.Module:
        """The policy as a module of its own, ready to act: state feedback has made its first plan.

        Args:
            policies: a policy of each name, whose own weights stay as they are.
        """
        policy = copy.deepcopy(policies[self.name])
        policy.load_state_dict(self.weights)
        if isinstance(policy, StateFeedback):
            policy.begin()
        return policy


class Window(NamedTuple):
    """A window of operation, or the part of it before the system failed.

    Attributes:
        entries: its control intervals, of batch size ``1 k``; None if there are none.
        ended: why the system did not reach the end of the window; None if it did.
        report: what the safety layer did in it; None if there is no layer.
        acted: numbers about what acted at its end, such as the times of the solves of model predictive control.
    """

    entries: TensorDict | None
    ended: str | None = None
    report: SafetyReport | None = None
    acted: Mapping[str, float] | None = None


class Operation(ABC):
    """A real system in operation: windows come in, and policies are handed over, while the learner learns.

    ``orders`` holds the orders, by version, that later windows may have flown, or that the last one has. ``report`` is
    what the safety layer did in the window taken last, and ``acted`` numbers about what acted at its end, if there are
    any. ``version`` is the number of the latest order, -1 before the first.

    Args:
        system: the real system as the learner knows it.
    """

    def __init__(self, system: EnvBase):
        self.system, self.version = system, -1
        self.orders: dict[int, Order] = {}
        self.report: SafetyReport | None = None
        self.acted: Mapping[str, float] | None = None

    @property
    def closure(self) -> nn.Module | None:
        """The true closure of the system, as far as it is known."""
        closure: nn.Module | None = self.system.closure
        return closure

    def hand_over(
        self, name: str, policy: nn.Module, *, strength: float, found: dict[str, float | str] | None = None
    ) -> None:
        """Hand a policy over, which takes over while the system operates.

        Args:
            name: name of the policy: its role, or ``first``.
            policy: the policy, as it is now.
            strength: strength ξ of the exploration.
            found: what was found about the policy before, by name.
        """
        weights = {key: value.detach().clone() for key, value in policy.state_dict().items()}
        order = Order(self.version + 1, name, weights, strength, found)
        self._pass_on(order)
        self.version, self.orders[order.version] = order.version, order

    @abstractmethod
    def _pass_on(self, order: Order) -> None:
        """Pass an order on to what acts."""

    @abstractmethod
    def rollout(self) -> TensorDict:
        """The oldest window that has not been taken yet, of batch size ``1 n``; waits for it if necessary.

        Raises:
            EpisodeEndedError: if the system failed in that window, or ended it; it holds the intervals before.
        """

    @abstractmethod
    def waiting(self) -> bool:
        """Whether a further window has come in already."""

    @abstractmethod
    def close(self) -> None:
        """End the operation; the system gets its safe action from whatever stands behind it."""

    def _take(self, window: Window, acting: int) -> TensorDict:
        """The control intervals of a window, where it is a whole one.

        Args:
            window: the window.
            acting: version that acts at its end.
        """
        entries, self.report, self.acted = window.entries, window.report, window.acted
        versions = [] if entries is None else entries["version"].flatten().tolist()
        oldest = min([acting, *versions])
        self.orders = {version: order for version, order in self.orders.items() if version >= oldest}
        if window.ended is not None or entries is None:
            raise EpisodeEndedError(window.ended or "the window holds no interval", entries)
        return entries

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next window depends on, in tensors and plain containers."""
        return {
            "orders": [order._asdict() for order in self.orders.values()],
            "version": self.version,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of an operation that was built with the same arguments."""
        self.orders = {order["version"]: Order(**order) for order in state["orders"]}
        self.version = state["version"]


def system_of(env: EnvBase | Operation) -> EnvBase:
    """The real system itself, in operation or not."""
    return env.system if isinstance(env, Operation) else env


class Pace:
    """Waits for the beginning of each control interval.

    The attribute ``late`` is by how much the last interval began after it was due [s]. An interval that begins a whole
    period late or later is not made up for: the pace goes on from the moment when it began.

    Args:
        period: time from one beginning to the next [s].
        clock: wall clock [s].
        sleep: function that waits for some time [s].

    Raises:
        ValueError: if the period is not positive.
    """

    def __init__(
        self,
        period: float,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        if not period > 0.0:
            raise ValueError(f"period={period} s of a control loop must be positive.")
        self.period, self._clock, self._sleep = period, clock, sleep
        self.late = 0.0
        self._due: float | None = None

    def begin(self) -> None:
        """Begin anew: the next interval is due at once."""
        self._due = None

    def shift(self, seconds: float | None) -> None:
        """Move all intervals to come by some time [s]; with None the present moment is when this one was due."""
        now = self._clock()
        self._due = now if seconds is None or self._due is None else self._due + seconds

    def wait(self) -> float:
        """Wait until the next interval is due; by how much it begins late [s]."""
        now = self._clock()
        due = now if self._due is None else self._due + self.period
        if due > now:
            self._sleep(due - now)
            now = self._clock()
        self.late = now - due
        self._due = now if self.late >= self.period else due
        return self.late


class Operator:
    """Steps a real system under the policies that it is ordered to follow, interval by interval.

    A window of operation has the length of the plant's episode. Without ``continuous`` it begins with a reset, as an
    episode does. With ``continuous`` only the first one does: state, offset of a handover and memory of state feedback
    go on over the end of a window, and the plant's clock begins anew.

    A window holds the entries of an episode and, for each interval, ``version``, the number of the order that acted,
    and ``late``, by how much the interval began after it was due [s].

    A window in which the system fails ends there, and the next one begins with a reset. A reset that fails is a window
    without intervals; where there is a pace, it is tried again in each period, and reported once in a window's length.

    Args:
        env: the real system, of batch size 1.
        actor: what acts.
        policies: a policy of each name that an order may have.
        continuous: whether only the first window begins with a reset.
        pace: pace of the control intervals, for a system that does not keep the time itself; None where it does, by an
            attribute ``pace``, and on a simulated clock.

    Raises:
        ValueError: if the operation is to be continuous and the system cannot go on without a reset.
    """

    def __init__(
        self,
        env: EnvBase,
        actor: BumplessPolicy,
        policies: dict[str, nn.Module],
        *,
        continuous: bool = False,
        pace: Pace | None = None,
    ):
        if continuous and not hasattr(innermost(env), "go_on"):
            raise ValueError(
                f"continuous operation needs a system that goes on without a reset, a PlantEnv or a RealSystem; "
                f"{type(innermost(env)).__name__} has no method go_on()."
            )
        self.env, self.actor, self.policies = env, actor, policies
        self.continuous, self._own_pace = continuous, pace
        self.pace: Pace | None = getattr(env, "pace", None) if pace is None else pace
        self.interval, self._failed_resets = 0, 0
        self._order: Order | None = None
        self._begun = False
        self._window: TensorDict | None = None
        self._row: TensorDictBase | None = None

    @property
    def length(self) -> int:
        """Number of control intervals of a window."""
        return int(self.actor.plant.n_steps)

    @property
    def version(self) -> int:
        """Number of the order that is followed; -1 before the first."""
        return -1 if self._order is None else self._order.version

    def follow(self, order: Order, made: nn.Module | None = None) -> None:
        """Let the policy of an order take over in the next interval.

        Args:
            order: the order.
            made: its policy, ready to act; None makes it.
        """
        policy = order.ready(self.policies) if made is None else made
        if self._order is not None and (self.continuous or self.interval % self.length):
            self.actor.hand_over(policy, strength=order.strength)
        else:
            self.actor.policy = policy
        self._order = order

    @torch.no_grad()
    def step(self) -> Window | None:
        """Act for one control interval.

        Returns:
            The window that ends with this interval; None within a window.

        Raises:
            ValueError: if there is no order yet.
            DivergenceError: if the system is a simulation that diverges.
        """
        if self._order is None:
            raise ValueError("nothing acts yet: give the operator its first order.")
        k = self.interval % self.length
        if k == 0:
            try:
                self._begin()
            except DivergenceError:
                raise
            except Exception as error:  # whatever a machine, its driver or its connection may raise
                return self._not_begun(error)
        if self._own_pace is not None:
            self._own_pace.wait()
        return self._interval(k)

    def _interval(self, k: int) -> Window | None:
        """Act in interval k of the window that has begun."""
        assert self._row is not None
        row = self._row.set("action", self.actor(self._row["observation"], self._row["state"], self._row["exogenous"]))
        try:
            row = self.env.step(row)
            self._store(k, row)
        except DivergenceError:
            raise
        except Exception as error:
            return self._ended(k, failure(error, self.actor.plant, k))
        self._row = self.env.step_mdp(row)
        self.interval += 1
        if k + 1 < self.length:
            early = row["next", "done"].any()
            return self._ended(k + 1, str(ended_early(row["next"], k + 1, self.actor.plant))) if early else None
        return Window(self._window, report=report_of(self.env), acted=self._acted())

    def _begin(self) -> None:
        """Begin a window."""
        assert self._order is not None
        if self.continuous and self._begun:
            self._row = self.env.go_on()
            self.actor.begin_window()
        else:
            pass_over(self.env)
            self._row = self.env.reset()
            self.actor.begin(self.actor.policy, strength=self._order.strength)
            if self._own_pace is not None:
                self._own_pace.begin()
        self._begun, self._window, self._failed_resets = True, None, 0

    def _not_begun(self, error: Exception) -> Window | None:
        """The window that a failed reset leaves, if it is to be reported."""
        if self.pace is not None:
            self.pace.wait()
        self._failed_resets += 1
        if self.pace is not None and (self._failed_resets - 1) % self.length:
            self._begun = False
            return None
        return self._ended(0, failure(error, self.actor.plant))

    def _ended(self, count: int, why: str) -> Window:
        """The window of which ``count`` intervals were acted in; the next one begins with a reset."""
        entries = None if self._window is None or not count else self._window[:, :count].clone()
        self.interval, self._begun = (self.interval // self.length + 1) * self.length, False
        return Window(entries, why, report_of(self.env) if count else None, self._acted() if count else None)

    def _acted(self) -> dict[str, float] | None:
        """Numbers about state feedback that acts."""
        policy = self.actor.policy
        return policy.report() if isinstance(policy, StateFeedback) else None

    def _store(self, k: int, row: TensorDictBase) -> None:
        """Copy an interval into the window, which is allocated at once because a stack at its end takes long."""
        assert self._order is not None
        if self._window is None:
            self._window = row.clone().unsqueeze(1).expand(1, self.length).clone()
            for name, kind in (("version", torch.int64), ("late", torch.float64)):
                self._window[name] = torch.zeros(1, self.length, 1, dtype=kind)
            self._places = [(self._window[key], key) for key in row.keys(True, True)]
            self._version, self._late = self._window["version"], self._window["late"]
        for place, key in self._places:
            place[:, k] = row[key]
        self._version[:, k], self._late[:, k] = self._order.version, 0.0 if self.pace is None else self.pace.late

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next window depends on, at the end of a window."""
        return {
            "env": self.env.state_dict(),
            "generator": self.actor.generator.get_state(),
            "interval": self.interval,
            "order": None if self._order is None else self._order._asdict(),
            "carried": self.actor.carried() if self.continuous else {},
            "present": self.env.present if self._can_go_on() else None,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of an operator that was built with the same arguments.

        A system whose state cannot be put back, which is every one but a simulation without anything around it, begins
        with a reset; without ``continuous`` all do. State feedback begins with its first memory.
        """
        self.env.load_state_dict(state["env"])
        self.actor.generator.set_state(state["generator"].cpu())
        self.interval = state["interval"]
        self._order, self._begun, self._row = None, False, None
        if state["order"] is not None:
            self.follow(Order(**state["order"]))
            self.actor.begin(self.actor.policy, strength=state["order"]["strength"])
        if state["present"] is not None:
            self.env.present, self._begun = state["present"], True
            self.actor.carry(state["carried"])

    def _can_go_on(self) -> bool:
        """Whether the next window begins in the present state, and this can be put back."""
        return self.continuous and self._begun and isinstance(self.env, PlantEnv)


@dataclass(frozen=True)
class Crew:
    """Everything that acts, in parts that can be sent to another process.

    Attributes:
        make_env: function that makes the real system, called in the process that acts.
        plant: physics of the twin, which gives actuators, ranges and control interval.
        policies: a policy of each name that an order may have.
        exploration: parameters of the noise.
        config: options of the operation.
        seed: seed of the noise.
    """

    make_env: Callable[[], EnvBase]
    plant: Plant
    policies: dict[str, nn.Module]
    exploration: ExplorationConfig
    config: OperationConfig
    seed: int

    def operator(self, env: EnvBase | None = None) -> Operator:
        """The operator of the real system.

        Args:
            env: the real system, if it has been made already.
        """
        env = self.make_env() if env is None else env
        generator = torch.Generator(device=env.device).manual_seed(self.seed)
        first = next(iter(self.policies.values()))
        actor = BumplessPolicy(self.plant, first, self.exploration, intervals=HANDOVER, generator=generator)
        paced = self.config.clock == "wall" and getattr(env, "pace", None) is None
        pace = Pace(self.plant.dt / self.config.speed) if paced else None
        return Operator(env, actor, self.policies, continuous=self.config.continuous, pace=pace)


class SimulatedOperation(Operation):
    """An operation in the process of the learner; see :class:`Operation` for the methods.

    Time is counted in control intervals. The learner learns from a window when it is complete, which takes ``learning``
    intervals; its policy then takes over, in the middle of a window. Windows that are completed while it learns are
    taken together. A window is computed when the learner takes it, and not before, so that a checkpoint after an
    episode never falls within a window.

    Args:
        operator: what acts.
        learning: time from taking a window to handing the next policy over, in control intervals.

    Raises:
        ValueError: if ``learning`` is negative.
    """

    def __init__(self, operator: Operator, *, learning: int):
        if learning < 0:
            raise ValueError(f"learning={learning} control intervals must not be negative.")
        super().__init__(operator.env)
        self.operator, self._learning = operator, learning
        self._coming: dict[int, int] = {}  # interval in which each version takes over
        self._now = 0

    def _pass_on(self, order: Order) -> None:
        if self.version >= 0:
            self._now += self._learning
        self._coming[order.version] = self._now

    def waiting(self) -> bool:
        return self.operator.interval + self.operator.length <= self._now

    def rollout(self) -> TensorDict:
        window = None
        while window is None:
            for version in [version for version, at in self._coming.items() if at <= self.operator.interval]:
                del self._coming[version]
                self.operator.follow(self.orders[version])
            window = self.operator.step()
        self._now = max(self._now, self.operator.interval)
        return self._take(window, self.operator.version)

    def close(self) -> None:
        """Do nothing, because the system stands still between two windows."""

    def state_dict(self) -> dict[str, Any]:
        parts = {"operator": self.operator.state_dict(), "coming": list(self._coming.items()), "now": self._now}
        return super().state_dict() | parts

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.operator.load_state_dict(state["operator"])
        self._coming, self._now = dict(state["coming"]), state["now"]
