"""Operation on a simulated clock: one process, in which the same run repeats to the bit."""

from pathlib import Path
from typing import Any

from tensordict import TensorDict

from rt_torchrl.systems.operation.operator import Operation, Operator, Order


class SimulatedOperation(Operation):
    """An operation in the process of the learner; see :class:`Operation` for the methods.

    Time is counted in control intervals. The learner learns from a window when it is complete, which takes ``learning``
    intervals; its policy then takes over, in the middle of a window. Windows that are completed while it learns are
    taken together. A window is computed when the learner takes it, and not before, so that a checkpoint after an
    episode never falls within a window.

    Args:
        operator: what acts.
        learning: time from taking a window to handing the next policy over, in control intervals.
        log: file of the events.

    Raises:
        ValueError: if ``learning`` is negative.
    """

    def __init__(self, operator: Operator, *, learning: int, log: Path | None = None):
        if learning < 0:
            raise ValueError(f"learning={learning} control intervals must not be negative.")
        super().__init__(operator.env, log)
        self.operator, self._learning = operator, learning
        self._coming: dict[int, int] = {}  # interval in which each version takes over
        self._now = 0

    def _pass_on(self, order: Order) -> None:
        if self.begun:
            self._now += self._learning
        self._coming[order.version] = self._now

    def waiting(self) -> bool:
        return (self.operator.windows + 1) * self.operator.length <= self._now

    def rollout(self) -> TensorDict:
        first = self.operator.interval
        orders: dict[int, list[Order]] = {}
        for version, interval in self._coming.items():
            if interval < first + self.operator.length:
                orders.setdefault(max(interval, first), []).append(self.orders[version])
        window = self.operator.fly(orders)
        acting = self.operator.version
        self._coming = {version: interval for version, interval in self._coming.items() if version > acting}
        self._now = max(self._now, self.operator.interval)
        return self._take(window, acting)

    def close(self) -> None:
        """Do nothing, because the system stands still between two windows."""

    def state_dict(self) -> dict[str, Any]:
        parts = {"operator": self.operator.state_dict(), "coming": list(self._coming.items()), "now": self._now}
        return super().state_dict() | parts

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.operator.load_state_dict(state["operator"])
        self._coming, self._now = dict(state["coming"]), state["now"]
