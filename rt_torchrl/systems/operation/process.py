"""Operation on the wall clock: the system is acted on in a process of its own while the learner learns."""

import multiprocessing
import pickle
from typing import TYPE_CHECKING, Any

from tensordict import TensorDict
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.interruption import safe_point
from rt_torchrl.systems.ended_process import end_process
from rt_torchrl.systems.operation.acting import STOP, Crew, act
from rt_torchrl.systems.operation.cores import chosen_core, learn_beside, require_realtime, run_on
from rt_torchrl.systems.operation.event_log import EventLog
from rt_torchrl.systems.operation.order import Order, OrderBook

if TYPE_CHECKING:
    from collections.abc import Mapping
    from multiprocessing.connection import Connection

    from rt_torchrl.systems.operation.window import Window
    from rt_torchrl.systems.safety_report import SafetyReport

LOOK = 0.1
"""Time after which the learner looks again whether Ctrl-C was pressed while it waits for a window [s]."""
END = 10.0
"""Time that the acting process has to end the operation [s]."""


class ProcessOperation:
    """An operation in a process of its own; see :class:`Operation` for the methods.

    Note: TorchRL's asynchronous collectors are not used. Their workers wait while the learner has not taken the last
    batch, copy weights in the middle of an interval, and do not say which version acted in which interval; here the
    control loop waits for nothing but its clock.

    The process begins with the first order, and ends with :meth:`close` or with the process of the learner.

    Args:
        crew: what acts.
        system: the real system as the learner knows it, made by the same function; it is never stepped here.
        log: log of the events.

    Raises:
        ValueError: if something that acts cannot be sent to another process, or the core cannot be used.
    """

    def __init__(self, crew: Crew, system: EnvBase, *, log: EventLog | None = None):
        self._core, self._realtime = chosen_core(crew.config.core), crew.config.realtime
        if self._realtime:
            require_realtime()
        try:
            self._parts = pickle.dumps(crew)
        except Exception as error:  # pickle raises many kinds
            raise ValueError(
                f"what acts cannot be sent to a process of its own ({type(error).__name__}: {error}); use the "
                "simulated clock, --operation.clock simulated, or policies and systems that pickle."
            ) from error
        self.system, self.log, self._length = system, log or EventLog(), crew.plant.n_steps
        self.version, self._windows = -1, 0
        self._state: dict[str, Any] | None = None
        self.orders = OrderBook()
        self.report: SafetyReport | None = None
        self.acted: Mapping[str, float] | None = None
        self._connection: Connection | None = None
        self._process: multiprocessing.process.BaseProcess | None = None

    @property
    def closure(self) -> nn.Module | None:
        closure: nn.Module | None = self.system.closure
        return closure

    @property
    def pid(self) -> int | None:
        """Number of the acting process; None while there is none."""
        return None if self._process is None else self._process.pid

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
        self._begin()
        self.version += 1
        self.orders[self.version] = Order.of(self.version, name, policy, strength=strength, found=found)
        self._send(self.orders[self.version])
        self.log.note("handed over", version=self.version)

    def _send(self, order: Order) -> None:
        assert self._connection is not None
        try:
            self._connection.send_bytes(pickle.dumps(order))
        except OSError as error:
            raise RuntimeError(self._failure()) from error

    def _begin(self) -> None:
        if self._process is not None:
            return
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        state = None if self._state is None else pickle.dumps(self._state)
        self._process = context.Process(
            target=act, args=(theirs, self._parts, state, self._core, self._realtime), daemon=True
        )
        self._process.start()
        theirs.close()
        self._before = learn_beside(self._core)
        for order in self.orders.values():
            if self._state is None or order.version > self._state["order"]["version"]:
                self._send(order)

    def waiting(self) -> bool:
        return self._connection is not None and self._connection.poll()

    def rollout(self) -> TensorDict:
        """See :meth:`Operation.rollout`.

        Raises:
            EpisodeEndedError: if the system failed in the window, or ended it.
            RuntimeError: if the acting process has failed; the message is its error.
        """
        self._begin()
        assert self._connection is not None
        while not self._connection.poll(LOOK):
            safe_point()
        try:
            kind, *found = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError) as error:
            raise RuntimeError(self._failure()) from error
        if kind == "failed":
            raise RuntimeError(f"the acting process has failed: {found[0]}")
        window: Window = found[0]
        self._state, self.report, self.acted = found[1], window.report, window.acted
        assert self._state is not None
        flown = window.segments(self._windows * self._length)
        self.orders.forget_before(flown[0][1] if flown else self._state["order"]["version"])
        self.system.load_state_dict(self._state["env"])
        self.log.note("taken", window=self._windows, flown=flown)
        self._windows += 1
        return window.whole()

    def _failure(self) -> str:
        """What an acting process that does not answer has said, as far as it has."""
        try:
            while self._connection is not None and self._connection.poll():
                kind, *found = pickle.loads(self._connection.recv_bytes())
                if kind == "failed":
                    return f"the acting process has failed: {found[0]}"
        except (EOFError, OSError):
            pass
        return "the acting process has ended without a word; it may have been killed."

    def close(self) -> None:
        if self._process is None:
            return
        assert self._connection is not None
        try:
            self._connection.send_bytes(pickle.dumps(STOP))
            while self._process.is_alive() and self._connection.poll(END):
                self._connection.recv_bytes()  # windows that nobody takes would keep it from ending
        except (EOFError, OSError):
            pass
        end_process(self._process, END)
        self._connection.close()
        self._process = self._connection = None
        run_on(self._before)

    def state_dict(self) -> dict[str, Any]:
        """See :meth:`Operation.state_dict`; the window under way is not in it, and is flown again."""
        return {
            "operator": {} if self._state is None else self._state,
            "orders": self.orders.state_dict(),
            "version": self.version,
            "windows": self._windows,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.close()
        self._state = state["operator"] or None
        self.orders.load_state_dict(state["orders"])
        self.version, self._windows = state["version"], state["windows"]
        self.log.resume(window=self._windows, version=self.version)
        if self._state is not None:
            self.system.load_state_dict(self._state["env"])
