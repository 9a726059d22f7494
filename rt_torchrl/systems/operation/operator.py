"""The acting side of an operation: control intervals of a real system, in windows of the length of an episode."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.systems.around_system import innermost
from rt_torchrl.systems.collectors import failure, pass_over
from rt_torchrl.systems.environment import PlantEnv, ended_early
from rt_torchrl.systems.operation.handover import BumplessPolicy
from rt_torchrl.systems.operation.order import Order, ready
from rt_torchrl.systems.operation.window import Window
from rt_torchrl.systems.pace import Pace
from rt_torchrl.systems.sound_part import report_of
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback


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
        self.interval, self.windows, self._failed_resets = 0, 0, 0
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
        policy = ready(order, self.policies) if made is None else made
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
        self.windows += 1
        return Window(self._window, report=report_of(self.env), acted=self._acted())

    def fly(self, orders: dict[int, list[Order]]) -> Window:
        """One window, at whose intervals the orders come, by number of the interval since the operation began."""
        while True:
            for order in orders.get(self.interval, ()):
                self.follow(order)
            found = self.step()
            if found is not None:
                return found

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
        self.windows += 1
        self.interval, self._begun = self.windows * self.length, False
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
            self._own = self._window["version"], self._window["late"]
        for place, key in self._places:
            place[:, k] = row[key]
        self._own[0][:, k], self._own[1][:, k] = self._order.version, 0.0 if self.pace is None else self.pace.late

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
        self.interval, self.windows = state["interval"], state["interval"] // self.length
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
