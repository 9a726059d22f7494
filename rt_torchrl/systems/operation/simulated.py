"""Operation on a simulated clock: one process, in which the same run repeats to the bit."""

from typing import TYPE_CHECKING, Any

from tensordict import TensorDict
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.systems.operation.event_log import EventLog
from rt_torchrl.systems.operation.operator import Operator
from rt_torchrl.systems.operation.order import Order, OrderBook

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rt_torchrl.systems.safety_report import SafetyReport


class SimulatedOperation:
    """An operation in the process of the learner; see :class:`Operation` for the methods.

    Time is counted in control intervals. The learner learns from a window when it is complete, which takes ``learning``
    intervals; its policy then takes over, in the middle of a window. Windows that are completed while it learns are
    taken together. A window is computed when the learner takes it, and not before, so that a checkpoint after an
    episode never falls within a window.

    Args:
        operator: what acts.
        learning: time from taking a window to handing the next policy over, in control intervals.
        log: log of the events.

    Raises:
        ValueError: if ``learning`` is negative.
    """

    def __init__(self, operator: Operator, *, learning: int, log: EventLog | None = None):
        if learning < 0:
            raise ValueError(f"learning={learning} control intervals must not be negative.")
        self.operator, self._learning, self.log = operator, learning, log or EventLog()
        self.orders = OrderBook()
        self.report: SafetyReport | None = None
        self.acted: Mapping[str, float] | None = None
        self._at: dict[int, int] = {}
        self.version, self._now = -1, 0

    @property
    def closure(self) -> nn.Module | None:
        closure: nn.Module | None = self.operator.env.closure
        return closure

    @property
    def begun(self) -> bool:
        return self.version >= 0

    def hand_over(
        self,
        name: str,
        policy: nn.Module,
        *,
        strength: float,
        found: dict[str, float | str] | None = None,
    ) -> None:
        if self.begun:
            self._now += self._learning
        self.version += 1
        self.orders[self.version] = Order.of(self.version, name, policy, strength=strength, found=found)
        self._at[self.version] = self._now
        self.log.note("handed over", version=self.version)

    def waiting(self) -> bool:
        return (self.operator.windows + 1) * self.operator.length <= self._now

    @property
    def system(self) -> EnvBase:
        """See :attr:`Operation.system`."""
        return self.operator.env

    def rollout(self) -> TensorDict:
        """See :meth:`Operation.rollout`.

        Raises:
            EpisodeEndedError: if the system failed in the window, or ended it.
        """
        first = self.operator.interval
        coming: dict[int, list[Order]] = {}
        for version, at in self._at.items():
            if at < first + self.operator.length:
                coming.setdefault(max(at, first), []).append(self.orders[version])
        window = self.operator.fly(coming)
        self._at = {version: at for version, at in self._at.items() if version > self.operator.version}
        self._now, self.report = max(self._now, self.operator.interval), window.report
        self.acted = window.acted
        flown = window.segments(first)
        self.orders.forget_before(flown[0][1] if flown else self.operator.version)
        self.log.note("taken", window=self.operator.windows - 1, flown=flown)
        return window.whole()

    def close(self) -> None:
        """Do nothing, because the system stands still between two windows."""

    def state_dict(self) -> dict[str, Any]:
        return {
            "operator": self.operator.state_dict(),
            "orders": self.orders.state_dict(),
            "at": list(self._at.items()),
            "version": self.version,
            "now": self._now,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.operator.load_state_dict(state["operator"])
        self.orders.load_state_dict(state["orders"])
        self._at = dict(state["at"])
        self.version, self._now = state["version"], state["now"]
        self.log.resume(window=self.operator.windows, version=self.version)
