"""The acting process of an operation on the wall clock."""

import gc
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from queue import Empty, SimpleQueue
from typing import Any

import torch
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.plants.plant import Plant
from rt_torchrl.systems.exploration import ExplorationConfig
from rt_torchrl.systems.operation.config import OperationConfig
from rt_torchrl.systems.operation.cores import act_on, behind_others
from rt_torchrl.systems.operation.handover import BumplessPolicy
from rt_torchrl.systems.operation.operator import Operator
from rt_torchrl.systems.operation.order import ready
from rt_torchrl.systems.pace import Pace
from rt_torchrl.trajectories.state_feedback import StateFeedback

SWITCH = 2e-4
"""Time for which a thread keeps Python's lock while the control loop waits for it [s]."""
STOP = "stop"


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
        handover = self.config.handover
        actor = BumplessPolicy(self.plant, first, self.exploration, intervals=handover, generator=generator)
        paced = self.config.clock == "wall" and getattr(env, "pace", None) is None
        pace = Pace(self.plant.dt / self.config.speed) if paced else None
        return Operator(env, actor, self.policies, continuous=self.config.continuous, pace=pace)


def act(connection: Connection, parts: bytes, state: bytes | None, core: int | None, realtime: bool) -> None:
    """Operate the real system until the learner says stop or has gone; the main function of the acting process.

    Two threads talk to the learner, so that the control loop never waits for it. The one that receives an order also
    makes its policy and, of state feedback, the first plan: the machine code of a first one takes seconds.

    Args:
        connection: connection to the learner.
        parts: the pickled crew.
        state: pickled state of the operator to go on from; None for a new operation.
        core: core that this process has for itself; None for any.
        realtime: whether it runs before all others.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the learner's, which then says stop
    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH)
    act_on(core, realtime=realtime)
    orders: SimpleQueue[Any] = SimpleQueue()
    windows: SimpleQueue[Any] = SimpleQueue()
    sender = threading.Thread(target=_send, args=(connection, windows), daemon=True)
    sender.start()
    try:
        crew: Crew = pickle.loads(parts)
        threading.Thread(target=_receive, args=(connection, orders, crew.policies, realtime), daemon=True).start()
        _operate(crew, None if state is None else pickle.loads(state), orders, windows)
    except BaseException as error:  # any error goes to the learner, because nobody sees this one
        windows.put(("failed", f"{type(error).__name__}: {error}", traceback.format_exc()))
    windows.put(None)
    sender.join()


def _operate(crew: Crew, state: dict[str, Any] | None, orders: SimpleQueue[Any], windows: SimpleQueue[Any]) -> None:
    operator = crew.operator()
    try:
        if state is not None:
            operator.load_state_dict(state)
        order = _sound(orders.get())
        gc.collect()
        gc.freeze()  # a collection of all objects that the libraries have made would stop an action
        while order != STOP:
            if order is not None:
                operator.follow(*order)
            window = operator.step()
            if window is not None:
                windows.put(("window", window, operator.state_dict()))
            order = _next(orders)
            while order is not None and order != STOP and not orders.empty():
                operator.follow(*order)
                order = _next(orders)
    finally:
        gc.unfreeze()  # otherwise libraries report at the end of the process what nobody has freed
        operator.env.close()


def _next(orders: SimpleQueue[Any]) -> Any:
    try:
        return _sound(orders.get_nowait())
    except Empty:
        return None


def _sound(found: Any) -> Any:
    """What the receiving thread has put into the queue, or raise its error."""
    if isinstance(found, Exception):
        raise found
    return found


def _receive(connection: Connection, orders: SimpleQueue[Any], policies: dict[str, nn.Module], realtime: bool) -> None:
    try:
        while True:
            found = pickle.loads(connection.recv_bytes())
            if found == STOP:
                orders.put(STOP)
                continue
            # A policy is made in less than a millisecond, and state feedback with its first plan in seconds.
            with behind_others(realtime=realtime and isinstance(policies[found.name], StateFeedback)):
                orders.put((found, ready(found, policies)))
    except (EOFError, OSError):
        orders.put(STOP)  # a learner that has gone
    except Exception as error:  # such as a model that diverges under every first plan
        orders.put(error)


def _send(connection: Connection, windows: SimpleQueue[Any]) -> None:
    try:
        while (found := windows.get()) is not None:
            connection.send_bytes(pickle.dumps(found))
    except OSError:
        return  # a learner that has gone
