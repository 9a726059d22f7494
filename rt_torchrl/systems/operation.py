"""A real system in operation: it acts in a process of its own while the algorithm learns, in windows of episode length.

docs/connect_your_machine.md explains it.
"""

import contextlib
import copy
import gc
import multiprocessing
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, Final, NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from rt_torchrl.interruption import safe_point
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds, differences
from rt_torchrl.systems.collectors import fly, reset, together
from rt_torchrl.systems.config import OperationConfig
from rt_torchrl.systems.exploration import BumplessPolicy, ExplorationConfig
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.systems.safety import SafetyReport, report_of
from rt_torchrl.systems.sound_part import EpisodeEndedError
from rt_torchrl.trajectories.state_feedback import StateFeedback

FIRST: Final = "first"
"""Name of the policy or state feedback that acts before the trained policies do."""
LOOK = 0.1
"""Time after which the learner looks again whether Ctrl-C was pressed while it waits for a window [s]."""
END = 10.0
"""Time that the acting process has to end the operation [s]."""
SWITCH = 2e-4
"""Time for which a thread keeps Python's lock while the control loop waits for it [s]."""
MOMENTS = 64
"""Number of moments of an episode in which a plant is asked whether it depends on the time."""
LATER = 1000
"""Number of horizons, which is not reached, by which it is asked again later."""


class Order(NamedTuple):
    """A policy that is to take over at once, as it was when the order was given.

    Attributes:
        version: number of the order, from 0; each interval of a record names the version that acted in it.
        name: name of the policy, such as its role.
        weights: its weights.
        strength: strength ξ of the exploration.
        report: what is known of the policy beforehand, such as ``predicted_violations``, by name.
    """

    version: int
    name: str
    weights: dict[str, Tensor]
    strength: float
    report: dict[str, float | str] | None = None

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
        entries: its control intervals, None if there are none: a list of them where they are flown, one TensorDict of
            batch size ``1 k`` where they are taken.
        ended: why the system did not reach the end of the window; None if it did.
        report: what the safety layer did in it; None if there is no layer.
        acted: numbers about what acted at its end, such as the times of the solves of model predictive control.
    """

    entries: Any
    ended: str | None = None
    report: SafetyReport | None = None
    acted: Mapping[str, float] | None = None


class Pace:
    """Waits for the beginning of each control interval.

    The attribute ``late`` is by how much the last interval began after it was due [s]. An interval that begins a whole
    period late or later is not made up for: the pace goes on from the moment when it began.

    Args:
        period: time from one beginning to the next [s].

    Raises:
        ValueError: if the period is not positive.
    """

    clock = staticmethod(time.monotonic)
    """Wall clock [s]."""
    sleep = staticmethod(time.sleep)
    """Waits for some time [s]."""

    def __init__(self, period: float):
        if not period > 0.0:
            raise ValueError(f"period={period} s of a control loop must be positive.")
        self.period = period
        self._due: float | None
        self.begin()

    def begin(self) -> None:
        """Begin anew: the next interval is due at once."""
        self._due, self.late = None, 0.0

    def shift(self, seconds: float | None) -> None:
        """Move all intervals to come by some time [s]; with None the present moment is when this one was due."""
        now = self.clock()
        self._due = now if seconds is None or self._due is None else self._due + seconds

    def wait(self) -> None:
        """Wait until the next interval is due."""
        now = self.clock()
        due = now if self._due is None else self._due + self.period
        if due > now:
            self.sleep(due - now)
            now = self.clock()
        self.late = now - due
        self._due = now if self.late >= self.period else due


@dataclass
class Operator:
    """Steps a real system under the policies that it is ordered to follow.

    A window of operation has the length of the plant's episode. Without ``continuous`` it begins with a reset, as an
    episode does. With ``continuous`` only the first one does: state, offset of a handover and memory of state feedback
    go on over the end of a window, and the plant's clock begins anew.

    A window holds the entries of an episode and, for each interval, ``version``, the number of the order that acted,
    and ``late``, by how much the interval began after it was due [s].

    A window in which the system fails ends there, and the next one begins with a reset. A reset that fails is a window
    without intervals.

    An operator can be sent to another process until :meth:`start` makes the real system.

    Args:
        make_env: function that makes the real system, of batch size 1. One that keeps the time itself says so by an
            attribute ``pace``.
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

    def start(self) -> None:
        """Make the real system, and what acts on it."""
        self.env, self._begun = self.make_env(), False
        self._order: Order
        generator, first = torch.Generator(device=self.env.device), next(iter(self.policies.values()))
        generator.manual_seed(self.seed)
        self.actor = BumplessPolicy(self.plant, first, self.exploration, generator=generator)
        pace: Pace | None = getattr(self.env, "pace", None)
        self._keeps_time = pace is None
        self.pace = Pace(self.plant.dt / self.config.speed) if pace is None else pace

    def follow(self, order: Order, policy: nn.Module) -> None:
        """Let the policy of an order, which is ready to act, take over in the next interval."""
        if self._begun:
            self.actor.hand_over(policy, strength=order.strength)
        else:
            self.actor.policy = policy
        self._order = order

    @torch.no_grad()
    def window(self, receive: Callable[[], None]) -> Window:
        """Act for a window.

        Args:
            receive: function that is called before each interval, and may give orders to :meth:`follow`; the first
                order comes before the first window.

        Raises:
            DivergenceError: if the system is a simulation that diverges.
        """
        receive()

        def act(k: int, row: TensorDictBase) -> TensorDictBase:
            if k:
                receive()
            if self._keeps_time:
                self.pace.wait()
            row["version"] = torch.full((1, 1), self._order.version)
            row["late"] = torch.full((1, 1), self.pace.late, dtype=torch.float64)
            return row.set("action", self.actor(row["observation"], row["state"], row["exogenous"]))

        rows, why = fly(self.env, self._begin, act, self.plant)
        self._begun = self.config.continuous and why is None
        if not rows:
            return Window(None, why)
        policy = self.actor.policy
        acted = policy.report() if isinstance(policy, StateFeedback) else None
        return Window(rows, why, report_of(self.env), acted)

    def _begin(self) -> TensorDictBase:
        """Begin a window, and return what is read first."""
        if self._begun:
            assert isinstance(self.env, RealSystem)
            self.actor.begin_window()
            return self.env.go_on()
        first_row = reset(self.env)
        self.actor.begin(self.actor.policy, strength=self._order.strength)
        if self._keeps_time:
            self.pace.begin()
        self._begun = True
        return first_row

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next window depends on, at the end of a window."""
        return {
            "env": self.env.state_dict(),
            "generator": self.actor.generator.get_state(),
            "order": self._order._asdict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of an operator that was built with the same arguments.

        The operation begins with a reset, and state feedback with its first memory.
        """
        self.env.load_state_dict(state["env"])
        self.actor.generator.set_state(state["generator"].cpu())
        order = Order(**state["order"])
        self.follow(order, order.ready(self.policies))


@torch.no_grad()
def answers_by_time(plant: Plant) -> list[str]:
    r"""Methods of a plant that answer otherwise whole horizons later, :math:`f(t + mT_o) \ne f(t)`.

    They are called within episodes: at t = 0, where one begins, past observations do not count.
    """
    generator = torch.Generator().manual_seed(0)
    state, inputs = plant.draw_initial_state(MOMENTS, generator), plant.draw_exogenous(MOMENTS, generator)[:, 0]
    low, high = (end.nan_to_num(posinf=1.0, neginf=-1.0) for end in bounds(plant.actions))
    action = low + (high - low) * torch.rand(MOMENTS, len(low), generator=generator, dtype=torch.float64)
    k = torch.randint(1, max(plant.n_steps, 2), (MOMENTS,), generator=generator)
    later = k + plant.n_steps * torch.randint(1, LATER, (MOMENTS,), generator=generator)

    def answers(t: Tensor) -> dict[str, Tensor]:
        end = plant.step(t, state, action, inputs, plant.closure).state
        cost = plant.running_cost(t, state, action, inputs)
        return {
            "step": differences(plant.states, end, state),
            "observe": plant.observe(t, state, inputs),
            "running_cost": cost,
        }

    # A periodic function of a time that is a thousand horizons later has its rounding.
    pairs = zip(answers(plant.dt * k.double()).items(), answers(plant.dt * later.double()).values(), strict=True)
    return [name for (name, x), y in pairs if ((x - y).abs() > 1e-6 * x.abs().amax(0) + 1e-12).any()]


class Operation:
    """A real system in operation: windows come in, and policies are handed over, while the learner learns.

    Note: TorchRL's asynchronous collectors are not used. Their workers wait while the learner has not taken the last
    batch, copy weights in the middle of an interval, and do not say which version acted in which interval; here the
    control loop waits for nothing but its clock.

    The process that acts begins with the first order, and ends with :meth:`close` or with the process of the learner. A
    failure of it is a RuntimeError in :meth:`rollout`, whose message is the process's own.

    ``orders`` holds the orders, by version, that later windows may have flown, or that the last one has. ``report`` is
    what the safety layer did in the window taken last, and ``acted`` numbers about what acted at its end, if there are
    any. ``version`` is the number of the latest order, -1 before the first.

    Args:
        operator: what acts.
        system: the real system as the learner knows it, made by the same function; it is never stepped here.

    Raises:
        ValueError: if something that acts cannot be sent to another process, or the operation is to be continuous and
            the system is no :class:`RealSystem`, or its plant depends on the time, see :func:`answers_by_time`.
    """

    def __init__(self, operator: Operator, system: EnvBase):
        if operator.config.continuous and not isinstance(system, RealSystem):
            raise ValueError(
                f"continuous operation needs a RealSystem, which goes on without a reset; {type(system).__name__} does "
                "not. Leave out --operation.continuous."
            )
        if operator.config.continuous and (timed := answers_by_time(operator.plant)):
            raise ValueError(
                f"continuous operation begins each window of {operator.plant.horizon:g} s at t = 0 again, but "
                f"{' and '.join(timed)} of plant {operator.plant.name!r} tell the time of one window from that of "
                "another. Give the horizon a whole number of the plant's periods, make what depends on the time a "
                "measured input, or leave out --operation.continuous."
            )
        try:
            self._operator = pickle.dumps(operator)
        except Exception as error:  # pickle raises many kinds
            raise ValueError(
                f"what acts cannot be sent to a process of its own ({type(error).__name__}: {error}); give "
                "policies and systems that pickle."
            ) from error
        self.system, self.version, self.continuous = system, -1, operator.config.continuous
        self.orders: dict[int, Order] = {}
        self.report: SafetyReport | None = None
        self.acted: Mapping[str, float] | None = None
        self._state: dict[str, Any] | None = None
        self._connection: Connection | None = None
        self._process: multiprocessing.process.BaseProcess | None = None

    @property
    def closure(self) -> nn.Module | None:
        """The true closure of the system, as far as it is known."""
        return cast(nn.Module | None, self.system.closure)

    def hand_over(
        self, name: str, policy: nn.Module, *, strength: float, report: dict[str, float | str] | None = None
    ) -> None:
        """Hand a policy over, which takes over while the system operates.

        Args:
            name: name of the policy: its role, or ``first``.
            policy: the policy, as it is now.
            strength: strength ξ of the exploration.
            report: what is known of the policy beforehand, by name.
        """
        weights = {key: value.detach().clone() for key, value in policy.state_dict().items()}
        order = Order(self.version + 1, name, weights, strength, report)
        self._pass_on(order)
        self.version, self.orders[order.version] = order.version, order

    def _pass_on(self, order: Order) -> None:
        """Pass an order on to what acts; why a process has ended is an error of its windows."""
        connection = self._begun()
        with contextlib.suppress(OSError):
            connection.send_bytes(pickle.dumps(order))

    def _begun(self) -> Connection:
        """The connection to the acting process, which is started where there is none."""
        if self._connection is not None:
            return self._connection
        context = multiprocessing.get_context("spawn")
        self._connection, acting_end = context.Pipe()
        state = None if self._state is None else pickle.dumps(self._state)
        self._process = context.Process(target=act, args=(acting_end, self._operator, state), daemon=True)
        self._process.start()
        acting_end.close()
        for order in self.orders.values():
            if self._state is None or order.version > self._state["order"]["version"]:
                self._pass_on(order)
        return self._connection

    def waiting(self) -> bool:
        """Whether a further window has come in already."""
        return self._connection is not None and self._connection.poll()

    def rollout(self) -> TensorDict:
        """The oldest window that has not been taken yet, of batch size ``1 n``; waits for it if necessary.

        Raises:
            EpisodeEndedError: if the system failed in that window, or ended it; it holds the intervals before.
            RuntimeError: if the acting process has failed or ended.
        """
        connection = self._begun()
        while not connection.poll(LOOK):
            safe_point()
        try:
            message = pickle.loads(connection.recv_bytes())
        except (EOFError, OSError) as error:
            raise RuntimeError("the acting process has ended without a word; it may have been killed.") from error
        if isinstance(message, str):
            raise RuntimeError(f"the acting process has failed: {message}")
        window, state = message
        self._state = state
        self.system.load_state_dict(state["env"])
        return self._take(window, state["order"]["version"])

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
        return cast(TensorDict, entries)

    def close(self) -> None:
        """End the operation; the system gets its safe action from whatever stands behind it."""
        if self._process is None or self._connection is None:
            return
        with contextlib.suppress(OSError):
            self._connection.send_bytes(pickle.dumps(None))
        self._connection.close()  # also for a window that nobody takes any more
        self._process.join(END)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process = self._connection = None

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next window depends on; the window under way is not in it, and is flown again."""
        orders = [order._asdict() for order in self.orders.values()]
        return {"orders": orders, "version": self.version, "operator": self._state or {}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of an operation that was built with the same arguments."""
        self.close()
        self.orders = {order["version"]: Order(**order) for order in state["orders"]}
        self.version, self._state = state["version"], state["operator"] or None
        if self._state is not None:
            self.system.load_state_dict(self._state["env"])


def system_of(env: EnvBase | Operation) -> EnvBase:
    """The real system itself, in operation or not."""
    return env.system if isinstance(env, Operation) else env


# The acting process


def act(connection: Connection, pickled: bytes, state: bytes | None) -> None:
    """Operate the real system until the learner says stop or has gone; the main function of the acting process.

    Two threads talk to the learner, so that the control loop never waits for it. The one that receives an order also
    makes its policy and, of state feedback, the first plan: the machine code of a first one takes seconds.

    Args:
        connection: connection to the learner.
        pickled: the pickled operator.
        state: its pickled state to go on from; None for a new operation.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the learner's, which then says stop
    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH)
    orders: SimpleQueue[Any] = SimpleQueue()
    windows: SimpleQueue[Any] = SimpleQueue()
    sender = threading.Thread(target=_send, args=(connection, windows), daemon=True)
    sender.start()
    try:
        operator: Operator = pickle.loads(pickled)
        threading.Thread(target=_receive, args=(connection, orders, operator.policies), daemon=True).start()
        _operate(operator, None if state is None else pickle.loads(state), orders, windows)
    except BaseException as error:  # any error goes to the learner, because nobody sees this one
        windows.put(f"{type(error).__name__}: {error}")
    windows.put(None)
    sender.join()


class _Stopped(Exception):
    """The learner says stop, or has gone."""


def _operate(
    operator: Operator, state: dict[str, Any] | None, orders: SimpleQueue[Any], windows: SimpleQueue[Any]
) -> None:
    operator.start()

    def receive(*, wait: bool = False) -> None:
        while wait or not orders.empty():
            order, wait = orders.get(), False
            if isinstance(order, Exception):  # of the receiving thread
                raise order
            operator.follow(*order)

    try:
        if state is not None:
            operator.load_state_dict(state)
        receive(wait=True)
        gc.collect()
        gc.freeze()  # a collection of all objects that the libraries have made would stop an action
        while True:
            window = operator.window(receive)
            windows.put((window, operator.state_dict()))
    except _Stopped:
        return
    finally:
        gc.unfreeze()  # otherwise libraries report at the end of the process what nobody has freed
        operator.env.close()


def _receive(connection: Connection, orders: SimpleQueue[Any], policies: dict[str, nn.Module]) -> None:
    end: Exception = _Stopped()
    try:
        while (order := pickle.loads(connection.recv_bytes())) is not None:
            # A policy is made in less than a millisecond, and state feedback with its first plan in seconds.
            orders.put((order, order.ready(policies)))
    except (EOFError, OSError):
        pass  # a learner that has gone
    except Exception as error:  # such as a model that diverges under every first plan
        end = error
    orders.put(end)


def _send(connection: Connection, windows: SimpleQueue[Any]) -> None:
    with contextlib.suppress(OSError):  # of a learner that has gone
        while (message := windows.get()) is not None:
            if not isinstance(message, str):  # a window, whose stack takes long and would keep the control loop waiting
                window, state = message
                message = window._replace(entries=together(window.entries)), state
            connection.send_bytes(pickle.dumps(message))
