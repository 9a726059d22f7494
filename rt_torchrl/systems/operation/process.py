"""Operation on the wall clock: the system is acted on in a process of its own while the learner learns."""

import gc
import multiprocessing
import pickle
import signal
import sys
import threading
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.interruption import safe_point
from rt_torchrl.systems.operation.operator import Crew, Operation, Order

LOOK = 0.1
"""Time after which the learner looks again whether Ctrl-C was pressed while it waits for a window [s]."""
END = 10.0
"""Time that the acting process has to end the operation [s]."""
SWITCH = 2e-4
"""Time for which a thread keeps Python's lock while the control loop waits for it [s]."""
STOP = "stop"


class ProcessOperation(Operation):
    """An operation in a process of its own; see :class:`Operation` for the methods.

    Note: TorchRL's asynchronous collectors are not used. Their workers wait while the learner has not taken the last
    batch, copy weights in the middle of an interval, and do not say which version acted in which interval; here the
    control loop waits for nothing but its clock.

    The process begins with the first order, and ends with :meth:`close` or with the process of the learner. A failure
    of the acting process is a RuntimeError in :meth:`rollout` or :meth:`hand_over`, whose message is the process's own.

    Args:
        crew: what acts.
        system: the real system as the learner knows it, made by the same function; it is never stepped here.

    Raises:
        ValueError: if something that acts cannot be sent to another process.
    """

    def __init__(self, crew: Crew, system: EnvBase):
        try:
            self._parts = pickle.dumps(crew)
        except Exception as error:  # pickle raises many kinds
            raise ValueError(
                f"what acts cannot be sent to a process of its own ({type(error).__name__}: {error}); use the "
                "simulated clock, --operation.clock simulated, or policies and systems that pickle."
            ) from error
        super().__init__(system)
        self._state: dict[str, Any] | None = None
        self._connection: Connection | None = None
        self._process: multiprocessing.process.BaseProcess | None = None

    def _pass_on(self, order: Order) -> None:
        connection = self._begun()
        try:
            connection.send_bytes(pickle.dumps(order))
        except OSError:
            while True:
                self._received(connection)  # after the windows, what the process has said at its end is raised

    def _begun(self) -> Connection:
        """The connection to the acting process, which is started where there is none."""
        if self._connection is not None:
            return self._connection
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        state = None if self._state is None else pickle.dumps(self._state)
        self._process = context.Process(target=act, args=(theirs, self._parts, state), daemon=True)
        self._process.start()
        theirs.close()
        for order in self.orders.values():
            if self._state is None or order.version > self._state["order"]["version"]:
                self._pass_on(order)
        return self._connection

    def waiting(self) -> bool:
        return self._connection is not None and self._connection.poll()

    def rollout(self) -> TensorDict:
        connection = self._begun()
        while not connection.poll(LOOK):
            safe_point()
        window, self._state = self._received(connection)
        assert self._state is not None
        self.system.load_state_dict(self._state["env"])
        return self._take(window, self._state["order"]["version"])

    def _received(self, connection: Connection) -> list[Any]:
        """The next window of the acting process, and its state; an error where it has failed or ended."""
        try:
            kind, *parts = pickle.loads(connection.recv_bytes())
        except (EOFError, OSError) as error:
            raise RuntimeError("the acting process has ended without a word; it may have been killed.") from error
        if kind == "failed":
            raise RuntimeError(f"the acting process has failed: {parts[0]}")
        return parts

    def close(self) -> None:
        if self._process is None or self._connection is None:
            return
        try:
            self._connection.send_bytes(pickle.dumps(STOP))
            while self._process.is_alive() and self._connection.poll(END):
                self._connection.recv_bytes()  # windows that nobody takes would keep it from ending
        except (EOFError, OSError):
            pass
        end_process(self._process, END)
        self._connection.close()
        self._process = self._connection = None

    def state_dict(self) -> dict[str, Any]:
        """See :meth:`Operation.state_dict`; the window under way is not in it, and is flown again."""
        return super().state_dict() | {"operator": self._state or {}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.close()
        super().load_state_dict(state)
        self._state = state["operator"] or None
        if self._state is not None:
            self.system.load_state_dict(self._state["env"])


def end_process(process: Any, within: float) -> None:
    """Wait until a process of ``multiprocessing`` has ended, and kill it if it does not.

    Args:
        process: the process, which knows that it is to end.
        within: longest time until it has ended [s].
    """
    process.join(within)
    if process.is_alive():
        process.kill()
        process.join()


# The acting process


def act(connection: Connection, parts: bytes, state: bytes | None) -> None:
    """Operate the real system until the learner says stop or has gone; the main function of the acting process.

    Two threads talk to the learner, so that the control loop never waits for it. The one that receives an order also
    makes its policy and, of state feedback, the first plan: the machine code of a first one takes seconds.

    Args:
        connection: connection to the learner.
        parts: the pickled crew.
        state: pickled state of the operator to go on from; None for a new operation.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the learner's, which then says stop
    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH)
    orders: SimpleQueue[Any] = SimpleQueue()
    windows: SimpleQueue[Any] = SimpleQueue()
    sender = threading.Thread(target=_send, args=(connection, windows), daemon=True)
    sender.start()
    try:
        crew: Crew = pickle.loads(parts)
        threading.Thread(target=_receive, args=(connection, orders, crew.policies), daemon=True).start()
        _operate(crew, None if state is None else pickle.loads(state), orders, windows)
    except BaseException as error:  # any error goes to the learner, because nobody sees this one
        windows.put(("failed", f"{type(error).__name__}: {error}"))
    windows.put(None)
    sender.join()


def _operate(crew: Crew, state: dict[str, Any] | None, orders: SimpleQueue[Any], windows: SimpleQueue[Any]) -> None:
    operator = crew.operator()
    try:
        if state is not None:
            operator.load_state_dict(state)
        order = orders.get()
        gc.collect()
        gc.freeze()  # a collection of all objects that the libraries have made would stop an action
        while order != STOP:
            if isinstance(order, Exception):  # of the receiving thread
                raise order
            if order is not None:
                operator.follow(*order)
            if orders.empty():  # otherwise the next order comes at once
                window = operator.step()
                if window is not None:
                    windows.put(("window", window, operator.state_dict()))
            order = None if orders.empty() else orders.get()
    finally:
        gc.unfreeze()  # otherwise libraries report at the end of the process what nobody has freed
        operator.env.close()


def _receive(connection: Connection, orders: SimpleQueue[Any], policies: dict[str, nn.Module]) -> None:
    try:
        while True:
            order = pickle.loads(connection.recv_bytes())
            # A policy is made in less than a millisecond, and state feedback with its first plan in seconds.
            orders.put(STOP if order == STOP else (order, order.ready(policies)))
    except (EOFError, OSError):
        orders.put(STOP)  # a learner that has gone
    except Exception as error:  # such as a model that diverges under every first plan
        orders.put(error)


def _send(connection: Connection, windows: SimpleQueue[Any]) -> None:
    try:
        while (window := windows.get()) is not None:
            connection.send_bytes(pickle.dumps(window))
    except OSError:
        return  # a learner that has gone
