"""A wind turbine behind OPC UA or Modbus: reinforcement twinning while it operates."""

import asyncio
import dataclasses
import logging
import math
import struct
import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import rt_torchrl as rt

rt.begin_loading(__name__)

import torch
from pydantic import Field
from wind_turbine import Config as Turbine

from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.options import Positive
from rt_torchrl.plants.signal import bounds

HOST, WRITTEN_AT = "127.0.0.1", 1000
"""Address of the server, and of the first register that a client writes; those that it reads begin at 0."""
SAFE = (2e4, 20.0)
"""Torque [N m] and pitch [deg] that slow the rotor down in any wind, and do not stop it."""


@rt.configuration
class Config(Turbine):
    """Train twin and controllers on a wind turbine at the other end of a protocol, while it operates without a stop.

    The server, which is this recipe with serve, simulates the turbine and never waits; start it first. The policies are
    judged in simulation.

    Args:
        protocol: what the server speaks, opcua or modbus.
        port: port of the server on this machine.
        serve: whether to be the server, until Ctrl-C; dt, pace and observe must be those of the training.
        pace: seconds of the turbine for each second: with the default, the control period of 0.5 s lasts 0.02 s.
    """

    protocol: Literal["opcua", "modbus"] = "modbus"
    port: Annotated[int, Field(ge=1, le=65535)] = 5020
    serve: bool = False
    pace: Positive = 25.0

    def __post_init__(self):
        super().__post_init__()
        if self.real != "simulation" or self.unknown:
            raise ValueError("real and unknown are other real systems; take recipes/wind_turbine.py.")


class ServedPlant:
    """A simulated plant that never stops; its watchdog brings the safe action in an interval without a valid command.

    A client reads the tags ``sample``, ``state.NAME``, ``exogenous.NAME`` and ``applied.NAME``. It writes
    ``command.NAME`` and ``answered``, the number of the sample that its commands answer.
    """

    def __init__(self, plant: rt.Plant, safe: tuple[float, ...], *, seed: int = 0):
        kinds = {"state": plant.readings, "exogenous": plant.inputs, "applied": plant.actions}
        self.entries = {kind: [f"{kind}.{signal.name}" for signal in signals] for kind, signals in kinds.items()}
        self.read = ["sample", *(tag for tags in self.entries.values() for tag in tags)]
        self.written = [*(f"command.{action.name}" for action in plant.actions), "answered"]
        self.plant, self.safe, self.sample = plant, torch.tensor([safe], dtype=torch.float64), 1
        self._generator = torch.Generator().manual_seed(seed)
        self._state, self._applied = plant.draw_initial_state(1, self._generator), torch.zeros_like(self.safe)
        self._inputs, self._k = plant.draw_exogenous(1, self._generator), 0

    def published(self) -> dict[str, float]:
        """The tags that a client reads, at the beginning of an interval."""
        values = self._state[:, : len(self.plant.readings)], self._inputs[:, self._k], self._applied
        return dict(zip(self.read, [float(self.sample), *torch.cat(values, -1)[0].tolist()], strict=True))

    @torch.no_grad()
    def advance(self, command: list[float], answered: float) -> None:
        """Run one interval under the command, or under the safe action."""
        action, (low, high) = torch.tensor([command], dtype=torch.float64), bounds(self.plant.actions)
        valid = answered == self.sample and bool(((action >= low) & (action <= high)).all())  # NaN is not
        t, z = torch.tensor([self._k * self.plant.dt]).double(), self._inputs[:, self._k]
        step = self.plant.step(t, self._state, action if valid else self.safe, z, self.plant.closure)
        self._state, self._applied = step.state, step.applied
        self.sample, self._k = self.sample + 1, self._k + 1
        if self._k == self.plant.n_steps:
            self._inputs, self._k = self.plant.draw_exogenous(1, self._generator), 0


async def opcua(served: ServedPlant, port: int):
    """Start a server; its functions that show what clients read, and that give what they have written."""
    from asyncua import Server, ua

    server, nodes = Server(), {}
    await server.init()
    server.set_endpoint(f"opc.tcp://{HOST}:{port}")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    await server.register_namespace("urn:rt_torchrl:plant")
    for tag in (*served.read, *served.written):
        nodes[tag] = await server.nodes.objects.add_variable(ua.NodeId.from_string(f"ns=2;s={tag}"), tag, math.nan)
    for tag in served.written:
        await nodes[tag].set_writable()
    await server.start()

    async def show(values):
        for tag, value in values.items():
            await nodes[tag].write_value(value)

    async def written():
        return [float(await nodes[tag].read_value()) for tag in served.written]

    return server.stop, show, written


async def modbus(served: ServedPlant, port: int):
    """The same over Modbus, with a double in four registers for each tag."""
    from pymodbus import simulator
    from pymodbus.server import ModbusTcpServer

    count, kind = len(served.written), simulator.DataType.REGISTERS
    sizes = {0: len(served.read), WRITTEN_AT: count}
    blocks = [simulator.SimData(first, values=[0] * 4 * size, datatype=kind) for first, size in sizes.items()]
    server = ModbusTcpServer(simulator.SimDevice(id=1, simdata=blocks), address=(HOST, port))
    await server.serve_forever(background=True)

    async def show(values):
        words = struct.unpack(f">{4 * len(values)}H", struct.pack(f">{len(values)}d", *values.values()))
        await server.async_setValues(1, 16, 0, list(words))

    async def written():
        words = await server.async_getValues(1, 3, WRITTEN_AT, 4 * count)
        return struct.unpack(f">{count}d", struct.pack(f">{4 * count}H", *words))

    return server.shutdown, show, written


async def serve(served: ServedPlant, protocol: str, port: int, period: float) -> None:
    """Run a plant at its pace until the task is cancelled."""
    stop, show, written = await {"opcua": opcua, "modbus": modbus}[protocol](served, port)
    try:
        await show(served.published())
        due = time.monotonic()
        while True:
            due = max(due + period, time.monotonic())
            await asyncio.sleep(due - time.monotonic())
            *command, answered = await written()
            served.advance(command, answered)
            await show(served.published())
    finally:
        await stop()


def machine(plant: rt.Plant, safe: tuple[float, ...], protocol: str, port: int, period: float, log: Path | None = None):
    """The real system at the other end, which connects at its first reset."""

    served = ServedPlant(plant, safe)
    if protocol == "opcua":
        from asyncua.sync import Client

        read, written = ({tag: f"ns=2;s={tag}" for tag in tags} for tags in (served.read, served.written))
        link = rt.OpcUaLink(partial(Client, f"opc.tcp://{HOST}:{port}"), read, written, timeout=0.8 * period)
    else:
        from pymodbus.client import ModbusTcpClient

        read = {tag: rt.Register(4 * k) for k, tag in enumerate(served.read)}
        written = {tag: rt.Register(WRITTEN_AT + 4 * k) for k, tag in enumerate(served.written)}
        link = rt.ModbusLink(ModbusTcpClient(HOST, port=port, timeout=0.8 * period, retries=0), read, written)
    entries = {key: tags for key, tags in served.entries.items() if tags}
    tags = {"sample": "sample", "answered": "answered"}
    client = rt.ConnectedPlant(link, entries, served.written[:-1], plant.actions, period=period, **tags)
    limits = rt.SafetyConfig(interval=plant.dt, ranges={"skipped": (-0.5, 0.5)}, log=log)
    places = {key: rt.Reading(keys=(key,)) for key in entries}
    return rt.RealSystem(
        rt.SafetyLayer(client, limits, fallback=safe), plant, **places, closure=plant.closure, seed=None
    )


def main(config: Config, **parts: Any) -> None:
    """Train, or serve; ``parts`` are further arguments of :class:`Run`, such as ``learner``."""
    plant, place = config.plant(), (config.protocol, config.port, config.dt / config.pace)
    if config.serve:
        print(f"the turbine is served over {config.protocol} on port {config.port}; Ctrl-C ends it", flush=True)
        logging.disable(logging.CRITICAL)  # clients that go away are no errors of this process
        asyncio.run(serve(ServedPlant(plant, SAFE, seed=config.seed), *place))
    config = dataclasses.replace(config, asynchronous=True, operation=rt.OperationConfig(continuous=True))
    env = partial(machine, plant, SAFE, *place)
    rt.Run(config, plant, env=env, first=JonkmanController, **parts).train()


if __name__ == "__main__":
    rt.main_of(Config, main)
