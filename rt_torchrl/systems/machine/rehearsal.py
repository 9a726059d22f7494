"""A simulated plant behind OPC UA or Modbus, in a process of its own, to rehearse the operation of a machine.

A plant is served by tags: its signals with their kind in front, and those that guard the connection.

====================  ==========================================================================================
tag                   meaning
====================  ==========================================================================================
``sample``            number of the sample; it counts up at the beginning of every control interval
``safe``              1 while the plant's own watchdog holds the safe action, because no valid command came
``missed``            number of control intervals without a valid command so far
``state.NAME``        a state as its sensor reads it, at the beginning of the interval
``input.NAME``        a measured exogenous input of the interval
``applied.NAME``      the action that was applied in the interval before
``answered``          written by the client: the number of the sample that its commands answer
``command.NAME``      written by the client: the command to an actuator
====================  ==========================================================================================
"""

import asyncio
import importlib
import logging
import math
import multiprocessing
import pickle
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.systems.config import SafetyConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.machine.connected_plant import ConnectedPlant, Link
from rt_torchrl.systems.machine.modbus import ModbusLink, Register
from rt_torchrl.systems.machine.opc_ua import OpcUaLink
from rt_torchrl.systems.operation.process import end_process
from rt_torchrl.systems.real_system import Reading, RealSystem
from rt_torchrl.systems.safety import SafetyLayer

HOST = "127.0.0.1"
"""Address of the server, which is on this machine."""
WRITTEN_AT = 1000
"""Address of the first register that a client writes; those that it reads begin at 0."""
ANSWER = 0.8
"""Share of the period within which the plant must answer a request."""
NONE = (-0.5, 0.5)
"""Range of a number of skipped samples that are none."""
START, END = 60.0, 10.0
"""Longest time until the server listens, and until it has ended [s]."""


def tags_of(plant: Plant) -> dict[str, tuple[str, ...]]:
    """Tags of a plant: those behind each vector that a client reads, and its ``commands``."""
    kinds = {"state": ("state", plant.readings), "exogenous": ("input", plant.inputs)}
    kinds |= {"applied": ("applied", plant.actions), "commands": ("command", plant.actions)}
    return {key: tuple(f"{prefix}.{signal.name}" for signal in signals) for key, (prefix, signals) in kinds.items()}


def read_tags(plant: Plant) -> tuple[str, ...]:
    """All tags that a client reads."""
    tags = tags_of(plant)
    return "sample", "safe", "missed", *tags["state"], *tags["exogenous"], *tags["applied"]


def written_tags(plant: Plant) -> tuple[str, ...]:
    """All tags that a client writes; the commands before the number that makes them valid."""
    return *tags_of(plant)["commands"], "answered"


class ServedPlant:
    """A plant in simulation that never stops: its exogenous inputs are drawn anew after each horizon.

    Interval k runs under the command that answers its sample, and under the safe action if none comes in the interval,
    or one that is not finite or out of its range. So a lost connection brings the safe action within one period: at the
    end of the interval that was answered last. The simulation computes an interval at its end, when it is known what
    came; a machine would hold the last command for the few milliseconds in which the next one may come. Before the
    first command the safe action acts.

    Args:
        plant: the plant, with its own closure.
        safe: safe action, one number for each actuator.
        seed: seed of the first state and of the inputs.

    Raises:
        ValueError: if the safe action does not fit the actuators.
    """

    def __init__(self, plant: Plant, safe: Sequence[float], *, seed: int = 0):
        self.plant, self._env = plant, PlantEnv(plant, seed=seed)
        self._low, self._high = bounds(plant.actions)
        self._safe = torch.tensor(tuple(safe), dtype=torch.float64)
        if self._safe.shape != self._low.shape or not self._valid(self._safe):
            ranges = [(action.name, action.low, action.high) for action in plant.actions]
            raise ValueError(f"safe={tuple(safe)} must be one number within the range of each action, {ranges}.")
        self._reported = self._env.reset()
        self._applied = self._reported["applied"]
        self.sample, self.missed, self.safe = 0, 0, True

    def _valid(self, command: Tensor) -> bool:
        return bool((command.isfinite() & (command >= self._low) & (command <= self._high)).all())

    def published(self) -> dict[str, float]:
        """All tags that a client reads, at the beginning of the interval."""
        vectors = self._reported["state"], self._reported["exogenous"], self._applied
        own = [float(self.sample), float(self.safe), float(self.missed)]
        return dict(zip(read_tags(self.plant), own + torch.cat(vectors, -1)[0].tolist(), strict=True))

    def advance(self, answered: float, command: Sequence[float]) -> None:
        """Run to the end of the interval.

        Args:
            answered: number of the sample that the command answers.
            command: command that the client has written last.

        Raises:
            DivergenceError: if the plant diverges.
        """
        acting = torch.tensor(tuple(command), dtype=torch.float64)
        self.safe = not (answered == self.sample and self._valid(acting))
        self.missed += self.safe
        acting = self._safe if self.safe else acting
        self._reported = self._env.step(self._reported.set("action", acting[None]))["next"].exclude("reward")
        self._applied, self.sample = self._reported["applied"], self.sample + 1
        if self.sample % self.plant.n_steps == 0:
            self._reported = self._env.go_on()


# Servers that show the tags


def own_nodes(tags: Sequence[str]) -> dict[str, str]:
    """Identifiers of the nodes of a served plant, by tag."""
    return {tag: f"ns=2;s={tag}" for tag in tags}


def own_registers(tags: Sequence[str], first: int = 0) -> dict[str, Register]:
    """Holding registers of a served plant, by tag: a double for each number, in a row."""
    width = Register(0).width
    return {tag: Register(first + width * k) for k, tag in enumerate(tags)}


class OpcUaServer:
    """The tags of a plant on an OPC UA server without security, for a rehearsal on one machine.

    Args:
        plant: plant that gives the tags.
        port: port on the local machine.
    """

    def __init__(self, plant: Plant, port: int):
        import asyncua

        self._package: Any = asyncua
        self._port, self._read, self._written = port, read_tags(plant), written_tags(plant)

    async def start(self) -> None:
        """Listen for clients."""
        ua, self._server = self._package.ua, self._package.Server()
        await self._server.init()
        self._server.set_endpoint(f"opc.tcp://{HOST}:{self._port}")
        self._server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        await self._server.register_namespace("urn:rt_torchrl:plant")
        folder = await self._server.nodes.objects.add_object(ua.NodeId("plant", 2), "plant")
        self._nodes = {}
        for tag, identifier in own_nodes((*self._read, *self._written)).items():
            node = await folder.add_variable(ua.NodeId.from_string(identifier), tag, math.nan, ua.VariantType.Double)
            self._nodes[tag] = node
            if tag in self._written:
                await node.set_writable()
        await self._server.start()

    async def show(self, values: Mapping[str, float]) -> None:
        """Show the tags that clients read."""
        for tag, value in values.items():
            await self._nodes[tag].write_value(value)

    async def asked(self) -> dict[str, float]:
        """The tags that clients write, as they are now."""
        return {tag: float(await self._nodes[tag].read_value()) for tag in self._written}

    async def stop(self) -> None:
        """Listen no more."""
        await self._server.stop()


class ModbusServer:
    """The tags of a plant on a Modbus TCP server; see :class:`OpcUaServer` for arguments and methods."""

    def __init__(self, plant: Plant, port: int):
        import pymodbus.client
        import pymodbus.server
        import pymodbus.simulator

        self._package, self._port = pymodbus, port
        self._client: Any = pymodbus.client.ModbusTcpClient
        self._read, self._written = read_tags(plant), written_tags(plant)

    async def start(self) -> None:
        simulator, width = self._package.simulator, Register(0).width
        blocks = [
            simulator.SimData(first, values=[0] * (width * len(tags)), datatype=simulator.DataType.REGISTERS)
            for first, tags in ((0, self._read), (WRITTEN_AT, self._written))
        ]
        device = simulator.SimDevice(id=1, simdata=blocks)
        self._server = self._package.server.ModbusTcpServer(device, address=(HOST, self._port))
        await self._server.async_setValues(1, 16, WRITTEN_AT, self._words([math.nan] * len(self._written)))
        await self._server.serve_forever(background=True)

    def _words(self, values: Sequence[float]) -> list[int]:
        kind = self._client.DATATYPE.FLOAT64
        return [word for value in values for word in self._client.convert_to_registers(float(value), kind)]

    async def show(self, values: Mapping[str, float]) -> None:
        await self._server.async_setValues(1, 16, 0, self._words([values[tag] for tag in self._read]))

    async def asked(self) -> dict[str, float]:
        width, kind = Register(0).width, self._client.DATATYPE.FLOAT64
        words = await self._server.async_getValues(1, 3, WRITTEN_AT, width * len(self._written))
        numbers = [self._client.convert_from_registers(words[k : k + width], kind) for k in range(0, len(words), width)]
        return dict(zip(self._written, map(float, numbers), strict=True))

    async def stop(self) -> None:
        await self._server.shutdown()


SERVERS: dict[str, Callable[[Plant, int], Any]] = {"opcua": OpcUaServer, "modbus": ModbusServer}
"""Servers by the name of their protocol."""
MODULES = {"opcua": "asyncua.sync", "modbus": "pymodbus.simulator"}
"""Module of another package that each protocol needs."""


def require_protocol(protocol: str) -> None:
    """Refuse a protocol that does not exist, or whose package is not installed.

    Raises:
        ValueError: if it is neither opcua nor modbus, or the extra machine is not installed.
    """
    if protocol not in MODULES:
        raise ValueError(f"protocol={protocol!r} does not exist; choose {' or '.join(MODULES)}.")
    try:
        importlib.import_module(MODULES[protocol])
    except ImportError as error:
        raise ValueError(
            f"protocol={protocol!r} needs a package ({error}): install the extra, pip install 'rt_torchrl[machine]'."
        ) from error


async def serve(
    served: ServedPlant,
    server: Any,
    period: float,
    *,
    ended: Callable[[], bool],
    begun: Callable[[], None] = lambda: None,
) -> None:
    """Run a plant at its pace until it is to end.

    Args:
        served: the plant.
        server: server that shows its tags, which is started and stopped here.
        period: wall-clock time of a control interval [s].
        ended: function that says whether to end.
        begun: function that is called when clients are answered.
    """
    commands = tags_of(served.plant)["commands"]
    await server.start()
    try:
        await server.show(served.published())
        begun()
        due = time.monotonic()
        while not ended():
            due = max(due + period, time.monotonic())
            await asyncio.sleep(due - time.monotonic())
            asked = await server.asked()
            served.advance(asked["answered"], [asked[tag] for tag in commands])
            await server.show(served.published())
    finally:
        await server.stop()


class ServerProcess:
    """A context in which a plant is in operation in another process, and answers on a port of this machine.

    Args:
        plant: the plant, with its own closure.
        safe: action that the plant's own watchdog brings, one number for each actuator.
        protocol: what the server speaks, opcua or modbus.
        port: port that the server listens on.
        period: wall-clock time of a control interval [s].
        seed: seed of the first state and of the inputs.

    Raises:
        ValueError: if the safe action does not fit, there is no such protocol or its package, or the server does not
            start, such as on a port that is in use.
    """

    def __init__(self, plant: Plant, safe: Sequence[float], *, protocol: str, port: int, period: float, seed: int = 0):
        require_protocol(protocol)
        if not 0 < port < 65536:
            raise ValueError(f"port={port} must lie in 1 ... 65535.")
        ServedPlant(plant, safe, seed=seed)
        self._arguments, self._port = pickle.dumps((plant, tuple(safe), protocol, port, period, seed)), port
        self._context = multiprocessing.get_context("spawn")

    def __enter__(self) -> "ServerProcess":
        self._ended, self._started = self._context.Event(), self._context.Event()
        arguments = (self._arguments, self._started, self._ended)
        self._process: Any = self._context.Process(target=run_server, args=arguments, daemon=True)
        self._process.start()
        until = time.monotonic() + START
        while not self._started.wait(0.1) and self._process.is_alive() and time.monotonic() < until:
            pass
        if not self._started.is_set():
            self.__exit__()
            raise ValueError(f"the plant server does not start on port={self._port}; another program may have it.")
        return self

    def __exit__(self, *raised: object) -> None:
        self._ended.set()
        end_process(self._process, END)


def run_server(arguments: bytes, started: Any, ended: Any) -> None:
    """The main function of the server's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that has started it says when to end
    torch.set_num_threads(1)
    plant, safe, protocol, port, period, seed = pickle.loads(arguments)
    logging.disable(logging.CRITICAL)  # clients that go away are no errors of this process, which is for nothing else
    served = ServedPlant(plant, safe, seed=seed)
    parent = multiprocessing.parent_process()

    def over() -> bool:
        return bool(ended.is_set()) or (parent is not None and not parent.is_alive())

    try:
        asyncio.run(serve(served, SERVERS[protocol](plant, port), period, ended=over, begun=started.set))
    except (OSError, RuntimeError) as error:  # pymodbus raises a RuntimeError if it cannot listen
        sys.exit(f"the plant server has ended: {error}")


# The client's side


def link_to(protocol: str, plant: Plant, port: int, *, period: float) -> Link:
    """The link to a plant that is served on this machine.

    Args:
        protocol: what the server speaks.
        plant: plant that is served.
        port: port of the server.
        period: control period on the wall clock [s].

    Raises:
        ValueError: if there is no such protocol, or its package is not installed.
    """
    require_protocol(protocol)
    read, written, timeout = read_tags(plant), written_tags(plant), ANSWER * period
    if protocol == "opcua":
        from asyncua.sync import Client

        client = partial(Client, f"opc.tcp://{HOST}:{port}")
        return OpcUaLink(client, own_nodes(read), own_nodes(written), timeout=timeout)
    from pymodbus.client import ModbusTcpClient

    tcp = ModbusTcpClient(HOST, port=port, timeout=timeout, retries=0)
    return ModbusLink(tcp, own_registers(read), own_registers(written, WRITTEN_AT))


def served_system(
    plant: Plant,
    *,
    safe: Sequence[float],
    protocol: Literal["opcua", "modbus"] = "opcua",
    port: int = 4840,
    period: float | None = None,
    log: Path | None = None,
) -> RealSystem:
    """The real system at the other end of a protocol. The connection is made at the first reset.

    Args:
        plant: physics of the twin, with the signals of the served plant.
        safe: action of the fallback, one number for each actuator; the plant's own watchdog should have the same.
        protocol: what the server speaks.
        port: port of the server on the local machine.
        period: control period on the wall clock [s]; by default the plant's control interval.
        log: file of the safety layer's events.

    Raises:
        ValueError: if there is no such protocol or its package.
    """
    wall = plant.dt if period is None else period
    tags = tags_of(plant)
    commands = tags.pop("commands")
    for package in ("asyncua", "pymodbus"):
        logging.getLogger(package).setLevel(logging.CRITICAL)  # a rehearsal loses connections, which the link notes
    env = ConnectedPlant(
        link_to(protocol, plant, port, period=wall),
        {key: names for key, names in tags.items() if names},
        commands,
        plant.actions,
        period=wall,
        sample="sample",
        answered="answered",
    )
    low, high = [state.low for state in plant.readings], [state.high for state in plant.readings]
    ranges = {"skipped": NONE} | ({"state": (low, high)} if any(map(math.isfinite, (*low, *high))) else {})
    guarded = SafetyLayer(env, SafetyConfig(interval=plant.dt, ranges=ranges, log=log), fallback=tuple(safe))
    return RealSystem(
        guarded,
        plant,
        state=Reading(keys=("state",)),
        exogenous=Reading(keys=("exogenous",)) if plant.inputs else None,
        applied=Reading(keys=("applied",)),
        seed=None,
    )
