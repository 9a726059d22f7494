"""Commands that a machine refuses, and readings that a machine or its layer refuses."""

import asyncio
import contextlib
import struct
from functools import partial

import pytest
import torch
from faulty_system import as_reported
from seeds_and_numbers import Time
from served_plants import free_port, in_a_thread
from test_served import ENTRIES, PLANT, Line
from test_served import connected as client_of

from rt_torchrl import ConnectedPlant, ModbusLink, OpcUaLink, Register, SafetyConfig, SafetyLayer
from rt_torchrl.systems.machine.connected_plant import LateAnswerError, LinkLostError, RefusedRequestError
from rt_torchrl.systems.sound_part import sound_part

HELD = {"double": 0.0, "float": 0.0, "whole": 0, "switch": False, "fixed": 0.0}
"""Nodes of the server with their first values; ``fixed`` takes no value from a client."""


class Controls:
    """An OPC UA server in a thread of the test, whose nodes the test reads and marks."""

    def __init__(self, ua, server, nodes, url):
        self.ua, self.nodes, self.url, self._server = ua, nodes, url, server

    def _now(self, work):
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(10.0)

    def held(self, tag):
        return self._now(self.nodes[tag].read_value())

    def mark(self, tag, value, status):
        """Let a sensor report a value with a status."""
        code = self.ua.StatusCode(getattr(self.ua.StatusCodes, status))
        kept = self.ua.Variant(value, self.ua.VariantType.Double)
        self._now(self._server.write_attribute_value(self.nodes[tag].nodeid, self.ua.DataValue(kept, code)))

    def link(self, read=("position", "velocity"), written=("double",), timeout=5.0):
        names = [{tag: f"ns=2;s={tag}" for tag in tags} for tags in (read, written)]
        client = partial(pytest.importorskip("asyncua.sync").Client, self.url)
        return OpcUaLink(client, *names, timeout=timeout)


@contextlib.asynccontextmanager
async def controls():
    asyncua = pytest.importorskip("asyncua")
    ua, server, nodes = asyncua.ua, asyncua.Server(), {}
    kinds = {"float": ua.VariantType.Float, "whole": ua.VariantType.Int16}
    await server.init()
    server.set_endpoint(url := f"opc.tcp://127.0.0.1:{free_port()}")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    await server.register_namespace("urn:test")
    for tag, value in (HELD | {"position": 0.5, "velocity": -0.25}).items():
        identifier = ua.NodeId.from_string(f"ns=2;s={tag}")
        nodes[tag] = await server.nodes.objects.add_variable(identifier, tag, value, kinds.get(tag))
        if tag in HELD and tag != "fixed":
            await nodes[tag].set_writable()
    async with server:
        yield Controls(ua, server, nodes, url)


@pytest.fixture(scope="module")
def server():
    with in_a_thread(controls()) as (found, loop):
        found.loop = loop
        yield found


def written(server, **values):
    link = server.link(written=tuple(values))
    link.connect()
    try:
        link.write(values)
    finally:
        link.close()


def test_a_command_takes_the_type_of_its_node(server):
    written(server, double=1.5, float=1.1, whole=-7.0)
    (single,) = struct.unpack("f", struct.pack("f", 1.1))
    assert (server.held("double"), server.held("float"), server.held("whole")) == (1.5, single, -7)


@pytest.mark.parametrize(
    ("tag", "value", "message"),
    [
        ("switch", 1.0, "'switch'.* holds Boolean.*a node of a numeric type"),
        ("whole", 1.5, "'whole' = 1.5 .* Int16: it takes whole numbers; give .* type Double"),
        ("whole", 4e4, "'whole' = 40000 .* Int16: .*32767"),
        ("float", 1e39, r"'float' = 1e\+39 .* Float"),
        ("fixed", 1.0, "'fixed' = 1 .*BadUserAccessDenied"),
        ("unknown", 1.0, "'unknown'.*BadNodeIdUnknown"),
    ],
)
def test_a_command_that_does_not_fit_its_node_is_refused_with_tag_value_and_reason(server, tag, value, message):
    with pytest.raises(RefusedRequestError, match=message):
        written(server, **{tag: value})
    assert [server.held(name) for name in ("switch", "fixed")] == [False, 0.0]


def guarded(link, plant=PLANT, command="double"):
    """A machine that does not report what it has applied."""
    period = 0.02
    env = ConnectedPlant(link, {"state": ("position", "velocity")}, (command,), plant.actions, period=period)
    layer = SafetyLayer(env, SafetyConfig(interval=plant.dt), fallback=(0.0,))
    return as_reported(layer, plant, exogenous=(0.0,), seed=None)


def act(system, row, command=1.0):
    return system.step(row.set("action", torch.tensor([[command]]).double()))


@pytest.mark.parametrize("status", ["UncertainLastUsableValue", "BadSensorFailure"])
def test_a_reading_that_is_not_good_is_missing_and_named_and_the_connection_stays(server, status):
    server.mark("velocity", -0.25, "Good")
    system = guarded(server.link())
    row = act(system, system.reset())
    assert row["next", "state"].tolist() == [[0.5, -0.25]] and not row["next", "refused"]
    server.mark("velocity", 77.0, status)
    row = act(system, system.step_mdp(row))
    assert row["next", "refused"] and row["next", "state"].tolist() == [[0.5, -0.25]]  # the last good ones
    client = system.env.env
    assert client.losses == 0
    (said,) = [event.reasons["not finite"] for event in system.env.report.events if "not finite" in event.reasons]
    assert f"velocity: {status}" in said and "position" not in said
    server.mark("velocity", 0.125, "Good")
    row = act(system, system.step_mdp(row))
    assert row["next", "state"].tolist() == [[0.5, 0.125]] and not row["next", "refused"]
    system.close()


@pytest.mark.parametrize("error", [LateAnswerError("busy"), LinkLostError("cut")])
def test_an_interval_whose_command_did_not_get_through_is_not_learned_from(error):
    """The machine holds its last command then, or its safe one; the record would say that it had the new one."""
    line = Line(Time(), 0.1, fails={("write", 6): error})
    entries = {key: ENTRIES[key] for key in ("state", "exogenous")}
    client = client_of(line, entries=entries)
    layer = SafetyLayer(client, SafetyConfig(interval=0.1), fallback=(0.0,))
    system = as_reported(layer, PLANT, seed=None)
    rows, row = [], system.reset()
    for _ in range(PLANT.n_steps):
        row = act(system, row, 0.5)
        rows.append(row)
        row = system.step_mdp(row)
        if client._connecting is not None:
            client._connecting.exception()
    found = sound_part(torch.stack(rows, 1)[0], PLANT, layer.report)
    assert found.parts == [(0, 5), (7, PLANT.n_steps)]
    (said,) = [event.reasons["not finite"] for event in layer.report.events if event.step == 5]
    assert str(error) in said
    system.close()


def test_an_error_of_the_link_beside_the_control_loop_is_raised_in_it_and_the_next_reset_connects():
    line = Line(Time(), 0.1, fails={("write", 1): LinkLostError("cut"), ("connect", 2): KeyError("cert.pem")})
    env = client_of(line)
    row, action = env.reset(), torch.tensor([1.0]).double()
    row = env.step(row.set("action", action))["next"]
    env._connecting.exception()
    with pytest.raises(KeyError, match=r"cert\.pem"):
        env.step(row.set("action", action))
    row = env.reset()
    assert line.requests["connect"] == 3 and env.step(row.set("action", action))["next", "state"].isfinite().all()
    env.close()


@contextlib.asynccontextmanager
async def registers(port, inputs):
    """A Modbus server of eight holding registers, which hold zeros, and of input registers, by address and word."""
    from pymodbus import simulator
    from pymodbus.server import ModbusTcpServer

    def block(first, values, kind="REGISTERS"):
        return simulator.SimData(first, values=values, datatype=simulator.DataType[kind])

    blocks = [block(0, [0] * 8)]
    if inputs:
        bits = [block(0, False, "BITS")]
        blocks = (bits, bits, blocks, [block(first, word) for first, word in inputs])
    running = ModbusTcpServer(simulator.SimDevice(id=1, simdata=blocks), address=("127.0.0.1", port))
    await running.serve_forever(background=True)
    try:
        yield
    finally:
        await running.shutdown()


@contextlib.contextmanager
def modbus(read, written, inputs=()):
    """A link to a Modbus server, and its client, which are connected."""
    package, port = pytest.importorskip("pymodbus.client"), free_port()
    client = package.ModbusTcpClient("127.0.0.1", port=port, timeout=2.0, retries=0)
    with in_a_thread(registers(port, inputs)), contextlib.closing(ModbusLink(client, read, written)) as link:
        link.connect()
        yield link, client


def test_a_modbus_exception_is_a_refusal_with_the_tags_and_the_machines_reason():
    with modbus({"pressure": Register(40)}, {"torque": Register(1000)}) as (link, client):
        with pytest.raises(RefusedRequestError, match="torque = 1.5.*illegal data address"):
            link.write({"torque": 1.5})
        with pytest.raises(RefusedRequestError, match="pressure.*illegal data address"):
            link.read()
        assert client.read_holding_registers(0, count=1, device_id=1).registers == [0]  # the connection is still there


def test_registers_have_a_type_a_scale_and_a_word_order():
    """Against the bytes of the standard: tenths, a float with its low word first, and a command in hundredths."""
    tags = {"level": Register(0, "int16", scale=0.1), "flow": Register(1, "float32", word_order="little")}
    written = {"valve": Register(4, "uint16", scale=0.01), "count": Register(5, "int16")}
    with modbus(tags, written) as (link, client):
        low, high = struct.unpack(">HH", struct.pack(">f", -2.5))[::-1]
        client.write_registers(0, [0xFFFF - 122, low, high], device_id=1)
        assert link.read() == {"level": pytest.approx(-12.3), "flow": -2.5}
        link.write({"valve": 0.256, "count": -3.0})
        assert client.read_holding_registers(4, count=2, device_id=1).registers == [26, 0xFFFF - 2]
        for values, tag in (({"valve": -0.5, "count": 0.0}, "valve"), ({"valve": 0.5, "count": 0.5}, "count")):
            with pytest.raises(RefusedRequestError, match=f"'{tag}' = {values[tag]:g} does not fit Register"):
                link.write(values)


def test_input_registers_are_read_in_one_request_of_their_own_table():
    """Function 4 of the standard, and not 3: the server holds other numbers in its holding registers."""
    tags = {"flow": Register(11, "float32", table="input"), "level": Register(10, "int16", scale=0.1, table="input")}
    words = [(10, 0xFFFF - 122), (11, 0x4048), (12, 0xF5C3)]
    with modbus(tags, {"valve": Register(0)}, words) as (link, client):
        requests, read = [], client.read_input_registers
        client.read_input_registers = lambda first, **options: (
            requests.append((first, options["count"])) or read(first, **options)
        )
        assert link.read() == {"flow": pytest.approx(3.14, rel=1e-7), "level": pytest.approx(-12.3)}
        assert requests == [(10, 3)]


def test_the_first_action_after_a_reset_moves_at_the_rate_from_what_the_machine_has_applied():
    """A machine in operation has an action before the first one of a policy, and says which."""
    line = Line(Time(), 0.1)
    line.plant.published = lambda published=line.plant.published: published() | {"applied.force": 1.5}
    layer = SafetyLayer(client_of(line), SafetyConfig(interval=0.1, rates=(5.0,)), fallback=(0.0,))
    row = layer.reset()
    layer.step(row.set("action", torch.tensor([-2.0]).double()))
    assert line.answer["command.force"] == 1.0
    layer.close()
