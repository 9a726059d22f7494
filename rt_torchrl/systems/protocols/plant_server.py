"""Serving a simulated plant at its pace, over OPC UA or Modbus."""

import asyncio
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

from rt_torchrl.systems.protocols.modbus import WIDTH, WRITTEN_AT, own_registers, pymodbus
from rt_torchrl.systems.protocols.opc_ua import asyncua, own_nodes
from rt_torchrl.systems.protocols.served_plant import ServedPlant
from rt_torchrl.systems.protocols.tags import ANSWERED, Tags


@runtime_checkable
class Board(Protocol):
    """The tags of a plant, as a server of some protocol shows them."""

    async def start(self) -> None:
        """Listen for clients."""

    async def show(self, values: Mapping[str, float]) -> None:
        """Show the tags that clients read."""

    async def asked(self) -> dict[str, float]:
        """The tags that clients write, as they are now."""

    async def stop(self) -> None:
        """Listen no more."""


class OpcUaBoard:
    """A board of an OPC UA server without security, for a rehearsal on one machine.

    Args:
        tags: tags of the plant.
        port: port on the local machine.
    """

    def __init__(self, tags: Tags, port: int):
        self._package, self._tags, self.url = asyncua(), tags, f"opc.tcp://127.0.0.1:{port}"

    async def start(self) -> None:
        ua = self._package.ua
        self._server = self._package.Server()
        await self._server.init()
        self._server.set_endpoint(self.url)
        self._server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        await self._server.register_namespace("urn:rt_torchrl:plant")
        folder = await self._server.nodes.objects.add_object(ua.NodeId("plant", 2), "plant")
        self._nodes = {}
        for tag, identifier in own_nodes((*self._tags.read, *self._tags.written)).items():
            node = await folder.add_variable(ua.NodeId.from_string(identifier), tag, math.nan, ua.VariantType.Double)
            self._nodes[tag] = node
            if tag in self._tags.written:
                await node.set_writable()
        await self._server.start()

    async def show(self, values: Mapping[str, float]) -> None:
        for tag, value in values.items():
            await self._nodes[tag].write_value(value)

    async def asked(self) -> dict[str, float]:
        return {tag: float(await self._nodes[tag].read_value()) for tag in self._tags.written}

    async def stop(self) -> None:
        await self._server.stop()


class ModbusBoard:
    """A board of a Modbus TCP server, for a rehearsal on one machine.

    Args:
        tags: tags of the plant.
        port: port on the local machine.
    """

    def __init__(self, tags: Tags, port: int):
        self._package, self._port = pymodbus(), port
        self._read, self._written = own_registers(tags.read), own_registers(tags.written, WRITTEN_AT)

    async def start(self) -> None:
        simulator = self._package.simulator
        blocks = [
            simulator.SimData(first, values=[0] * (WIDTH * len(registers)), datatype=simulator.DataType.REGISTERS)
            for first, registers in ((0, self._read), (WRITTEN_AT, self._written))
        ]
        device = simulator.SimDevice(id=1, simdata=blocks)
        self._server = self._package.server.ModbusTcpServer(device, address=("127.0.0.1", self._port))
        client = self._package.client.ModbusTcpClient
        self._from, self._to, self._kind = client.convert_from_registers, client.convert_to_registers, None
        self._kind = client.DATATYPE.FLOAT64
        await self._server.async_setValues(1, 16, WRITTEN_AT, self._words([math.nan] * len(self._written)))
        await self._server.serve_forever(background=True)

    def _words(self, values: list[float]) -> list[int]:
        return [word for value in values for word in self._to(float(value), self._kind)]

    async def show(self, values: Mapping[str, float]) -> None:
        await self._server.async_setValues(1, 16, 0, self._words([values[tag] for tag in self._read]))

    async def asked(self) -> dict[str, float]:
        words = await self._server.async_getValues(1, 3, WRITTEN_AT, WIDTH * len(self._written))
        starts = range(0, len(words), WIDTH)
        numbers = [float(self._from(words[k : k + WIDTH], self._kind)) for k in starts]
        return dict(zip(self._written, numbers, strict=True))

    async def stop(self) -> None:
        await self._server.shutdown()


BOARDS: dict[str, Callable[[Tags, int], Any]] = {"opcua": OpcUaBoard, "modbus": ModbusBoard}
"""Boards by the name of their protocol."""


async def serve(
    served: ServedPlant,
    board: Board,
    period: float,
    *,
    ended: Callable[[], bool],
    begun: Callable[[], None] = lambda: None,
) -> None:
    """Run a plant at its pace until it is to end.

    Args:
        served: the plant.
        board: its tags, which are started and stopped here.
        period: wall-clock time of a control interval [s].
        ended: function that says whether to end.
        begun: function that is called when clients are answered.
    """
    await board.start()
    try:
        await board.show(served.published())
        begun()
        due = time.monotonic()
        while not ended():
            due = max(due + period, time.monotonic())
            await asyncio.sleep(due - time.monotonic())
            asked = await board.asked()
            served.advance(asked[ANSWERED], [asked[tag] for tag in served.tags.commands])
            await board.show(served.published())
    finally:
        await board.stop()
