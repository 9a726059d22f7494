"""A plant behind OPC UA and Modbus, lost connections, and the recipes and the page that connect to one."""

import dataclasses
import json
import math
import socket
import sys
import threading
import time
from collections import Counter

import pytest
import torch
from linear_quadratic import LinearQuadratic
from printed_commands import blocks
from relay import Relay
from served_plants import free_port, served
from tensordict import TensorDict
from test_export_recipe import leave_run, recipe

from rt_torchrl.export.program import export_program
from rt_torchrl.runs.run_config import physics_of
from rt_torchrl.systems.machine.connected_plant import ConnectedPlant, LinkLostError
from rt_torchrl.systems.machine.modbus import ModbusLink, Register
from rt_torchrl.systems.machine.rehearsal import (
    ServedPlant,
    ServerProcess,
    link_to,
    served_system,
    tags_of,
    written_tags,
)
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.trajectories.rollout import Rollout

PLANT = LinearQuadratic(horizon=2.0)
ENTRIES = tags_of(PLANT)
COMMANDS = ENTRIES.pop("commands")
PROTOCOLS = [pytest.param("opcua", marks=pytest.mark.slow), "modbus"]  # a server of OPC UA starts in seconds


def test_a_served_plant_is_a_rollout_under_the_commands_that_answer_its_samples():
    plant = ServedPlant(PLANT, (0.0,), seed=3)
    asked = torch.linspace(-2.0, 2.0, PLANT.n_steps).double()
    states = []
    for k, command in enumerate(asked.tolist()):
        states.append([plant.published()[f"state.{state.name}"] for state in PLANT.states])
        plant.advance(float(k), [command])
    generator = torch.Generator().manual_seed(3)
    start, inputs = PLANT.draw_initial_state(1, generator), PLANT.draw_exogenous(1, generator)
    expected = Rollout(PLANT, PLANT.closure)(start, inputs, asked[None, :, None])
    torch.testing.assert_close(torch.tensor(states).double(), expected.states[0, :-1].detach())
    assert plant.missed == 0 and not plant.safe


@pytest.mark.parametrize("wrong", [(1, 1.0), (2, math.nan), (2, math.inf), (2, 2.001)])
def test_a_command_that_is_missing_or_wrong_brings_the_safe_action_in_its_interval(wrong):
    plant, applied = ServedPlant(PLANT, (-0.5,)), []
    for answered, command in [(0, 1.0), (1, 1.5), wrong, wrong, wrong, (5, 1.0)]:
        plant.advance(float(answered), [command])
        applied.append((plant.published()["applied.force"], plant.published()["safe"]))
    assert applied == [(1.0, 0.0), (1.5, 0.0), (-0.5, 1.0), (-0.5, 1.0), (-0.5, 1.0), (1.0, 0.0)]
    assert plant.missed == 3


@pytest.mark.parametrize("safe", [(), (0.0, 0.0), (math.nan,), (2.5,)])
def test_a_safe_action_that_does_not_fit_is_refused(safe):
    with pytest.raises(ValueError, match="safe=.* must be one number within the range of each action"):
        ServedPlant(PLANT, safe)


class Time:
    """A clock that goes on only when somebody waits."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


class Line:
    """A link to a served plant on a simulated clock: down between some times [s], or failing at numbered requests."""

    def __init__(self, time, period, down=(), fails=None):
        self.time, self.period, self.down, self.fails, self.requests = time, period, down, fails or {}, Counter()
        self.plant = ServedPlant(PLANT, (0.0,))
        self.answer = {"answered": math.nan, "command.force": math.nan}

    def _up(self, request):
        self.requests[request] += 1
        if (request, self.requests[request]) in self.fails:
            raise self.fails[request, self.requests[request]]
        while (self.plant.sample + 1) * self.period <= self.time.now + 1e-12:
            self.plant.advance(self.answer["answered"], [self.answer["command.force"]])
        if any(begin <= self.time.now < end for begin, end in self.down):
            raise LinkLostError("down")

    def connect(self):
        self._up("connect")

    def read(self):
        self._up("read")
        return self.plant.published()

    def write(self, values):
        self._up("write")
        self.answer = dict(values)

    def close(self):
        pass


def connected(line, entries=ENTRIES, **options):
    times = {"period": line.period, "clock": line.time, "sleep": line.time.sleep}
    return ConnectedPlant(
        line, entries, COMMANDS, PLANT.actions, **times, sample="sample", answered="answered", **options
    )


def test_a_client_answers_every_sample_of_the_plant():
    line = Line(Time(), 0.1)
    env = connected(line)
    found = env.rollout(50, lambda td: td.set("action", torch.ones(1).double()))
    assert line.plant.missed == 0 and env.losses == env.stale == env.skipped == 0
    assert (found["next", "applied"] == 1.0).all()
    assert line.time.now == pytest.approx(5.0, rel=0.02)


def test_a_client_keeps_its_period_while_the_line_is_down_and_goes_on_afterwards():
    line = Line(Time(), 0.1, down=[(1.05, 1.85)])
    env = connected(line)
    row, lost, times = env.reset(), [], []
    for _ in range(40):
        row = env.step(row.set("action", torch.tensor([1.0]).double()))["next"]
        lost.append(bool(row["state"].isnan().any()))
        times.append(line.time.now)
        if env._mender is not None and line.time.now >= 1.85:
            env._mender.join()
    assert env.losses == 1 and 8 <= sum(lost) <= 10 and lost.index(True) in (9, 10) and not any(lost[22:])
    # The period is kept: no step takes longer than one and a half of it, for the first look after the loss.
    assert max(b - a for a, b in zip(times, times[1:], strict=False)) <= 0.15 + 1e-9
    assert row["applied"].item() == 1.0
    env.close()


def test_a_plant_that_never_answers_is_said_in_a_sentence():
    line = Line(Time(), 0.1, down=[(0.0, math.inf)])
    with pytest.raises(ValueError, match="the plant has not answered for patience=2 s: down"):
        connected(line, patience=2.0).reset()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"period": 0.0}, "period=0.0 s"),
        ({"patience": 0.0}, "patience=0.0 s"),
        ({"answered": "answered"}, "answered='answered' takes the number of a sample"),
        ({"commands": ()}, "must be one tag for each of the actions"),
        ({"entries": {}}, "entries=.* must not be empty"),
    ],
)
def test_a_client_that_cannot_work_is_refused(options, message):
    given = {"entries": ENTRIES, "commands": COMMANDS, "period": 0.1, **options}
    entries, commands = given.pop("entries"), given.pop("commands")
    with pytest.raises(ValueError, match=message):
        ConnectedPlant(Line(Time(), 0.1), entries, commands, PLANT.actions, **given)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_plant_behind_a_protocol_does_what_its_twin_computes(protocol):
    """States, inputs and applied actions as they came over the line are a step of the plant, to the last digit."""
    pytest.importorskip({"opcua": "asyncua", "modbus": "pymodbus"}[protocol])
    with served(PLANT, protocol, safe=(0.0,), period=0.05) as (running, port):
        system = served_system(PLANT, safe=(0.0,), protocol=protocol, port=port, period=0.05)
        row, rows = system.reset(), []
        for k in range(12):
            row = system.step(row.set("action", torch.tensor([[0.1 * k - 0.5]]).double()))
            rows.append(row)
            row = system.step_mdp(row)
        system.close()
        env = system.env.env
        assert env.losses == 0
    flown = TensorDict.cat(rows)
    t, applied = torch.zeros(len(rows)).double(), flown["next", "applied"]
    ends = PLANT.step(t, flown["state"], applied, flown["exogenous"], PLANT.closure).state
    whole = ~flown["next", "refused"].flatten() & (env.skipped == 0 and env.stale == 0)
    assert whole.sum() >= 6 or env.skipped or env.stale  # a busy machine may miss a sample
    torch.testing.assert_close(ends[whole], flown["next", "state"][whole], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("registers", "message"),
    [
        ({"read": {}}, "read={} must name registers"),
        ({"read": {"a": Register(0), "b": Register(200)}}, "read spans 204 registers from 0 on"),
        ({"written": {"a": Register(0), "b": Register(8)}}, "one behind the other"),
        ({"written": {"a": Register(0, table="input")}}, "holding registers"),
        ({"read": {"a": Register(0), "b": Register(4, table="input")}}, "tables holding and input, and one request"),
    ],
)
def test_registers_that_no_request_takes_are_refused(registers, message):
    given = {"read": {"a": Register(0)}, "written": {"b": Register(4)}, **registers}
    with pytest.raises(ValueError, match=message):
        ModbusLink(None, **given)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "retries=3 of the client must be 0"),
        ({"retries": 0, "timeout": 80.0}, "timeout=80 s of the link must lie in 0 to 60 s.*1 ms is 0.001 s"),
        ({"retries": 0, "timeout": 0.0}, "timeout=0.0 s of the link must be positive"),
    ],
)
def test_a_modbus_client_that_would_hold_the_control_loop_is_refused(options, message):
    client = pytest.importorskip("pymodbus.client").ModbusTcpClient("127.0.0.1", **options)
    with pytest.raises(ValueError, match=message):
        ModbusLink(client, {"a": Register(0)}, {"b": Register(4)})


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_link_to_nobody_says_that_the_plant_does_not_answer(protocol):
    link = link_to(protocol, PLANT, free_port(), period=1.0)
    for work in (link.connect, link.read, lambda: link.write(dict.fromkeys(written_tags(PLANT), 0.0))):
        with pytest.raises(LinkLostError):
            work()
    link.close()


SIDES = {
    "server": lambda protocol: ServerProcess(PLANT, (0.0,), protocol=protocol, port=5020, period=0.1),
    "client": lambda protocol: served_system(PLANT, safe=(0.0,), protocol=protocol, period=0.1),
}


@pytest.mark.parametrize("side", SIDES)
def test_a_protocol_that_nobody_speaks_or_whose_package_is_not_there_is_refused(side, monkeypatch):
    with pytest.raises(ValueError, match="protocol='bacnet' does not exist; choose opcua or modbus"):
        SIDES[side]("bacnet")
    for protocol, package in (("opcua", "asyncua.sync"), ("modbus", "pymodbus.simulator")):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(ValueError, match=rf"'{protocol}' needs a package \(.*{package}.*install the extra"):
            SIDES[side](protocol)


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["opcua", "modbus"])
def test_a_port_in_use_is_said_without_a_traceback(protocol, capfd):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"port={port}"):
            ServerProcess(LinearQuadratic(), (0.0,), protocol=protocol, port=port, period=0.1).__enter__()
    assert "Traceback" not in capfd.readouterr().err


# Lost connections between a client and a served plant: cut off, and silent as with a cable that was pulled.


ENDLESS = LinearQuadratic(horizon=1e3)
PERIOD = 0.05
SAFE, ASKED = -0.5, 1.0


class Course:
    """What the plant has applied, sample by sample, and when; written by the plant's own thread."""

    def __init__(self, running):
        self.applied, self.times = [], []
        advance = running.advance

        def watched(answered, command):
            advance(answered, command)
            self.applied.append(running.published()["applied.force"])
            self.times.append(time.monotonic())

        running.advance = watched


def acting(system, row, steps):
    for _ in range(steps):
        row = system.step(row.set("action", torch.tensor([[ASKED]]).double()))
        row = system.step_mdp(row)
    return row


@pytest.mark.parametrize(
    ("protocol", "losses"),
    [
        pytest.param("modbus", 2, marks=pytest.mark.slow),
        pytest.param("opcua", 2, marks=[pytest.mark.slow, pytest.mark.nightly]),
        pytest.param("modbus", 30, marks=pytest.mark.faults),
        pytest.param("opcua", 30, marks=pytest.mark.faults),
    ],
)
def test_a_lost_connection_brings_the_safe_action_and_the_run_goes_on(protocol, losses):
    """Every loss brings the safe action within one period of the first command that stays out."""
    generator = torch.Generator().manual_seed(0)
    with served(ENDLESS, protocol, safe=(SAFE,), period=PERIOD) as (running, port):
        relay, course, moments = Relay(port), Course(running), []
        system = served_system(ENDLESS, safe=(SAFE,), protocol=protocol, port=relay.port, period=PERIOD)
        row = acting(system, system.reset(), 10)
        for k in range(losses):
            seconds = PERIOD * (2.0 + 4.0 * torch.rand((), generator=generator).item())
            moments.append(time.monotonic())
            (relay.cut if k % 2 else relay.stall)(seconds)
            row = acting(system, row, 8)
            for _ in range(100):  # until the plant follows again
                if not running.safe and not row["refused"].any():
                    break
                row = acting(system, row, 1)
            assert not running.safe, f"the run does not go on after loss {k}"
            row = acting(system, row, 2)
        env = system.env.env
        assert env.losses + env.late >= losses  # a short silence is a late answer or two, and no lost connection
        system.close()
        relay.close()
    for moment, following in zip(moments, [*moments[1:], course.times[-1]], strict=True):
        inside = [k for k, at in enumerate(course.times) if moment <= at < following]
        safe = [k for k in inside if course.applied[k] == SAFE]
        assert safe, "the loss has not brought the safe action"
        # The interval under way may be answered already. The next one runs under the safe action, and is noted at its
        # end: two periods, and half of one for a server that shares its core with the test.
        assert course.times[safe[0]] - moment <= 2.5 * PERIOD
        assert {course.applied[k] for k in inside} <= {SAFE, ASKED}


class Brittle:
    """A link on which the first writes after each of some connections fail."""

    def __init__(self, failures):
        self.failures, self.connections, self.sample = failures, 0, 0.0

    def connect(self):
        self.connections += 1

    def read(self):
        self.sample += 1.0
        return {"speed": 1.0, "sample": self.sample}

    def write(self, values):
        if self.connections <= self.failures:
            raise LinkLostError("cut")

    def close(self):
        pass


class Slow(ConnectedPlant):
    """A client whose mender takes a while from its new connection to its end."""

    @property
    def _connected(self):
        return self.__dict__.get("up", False)

    @_connected.setter
    def _connected(self, value):
        self.__dict__["up"] = value
        if value and threading.current_thread() is not threading.main_thread():
            time.sleep(0.1)


def test_a_loss_right_after_a_new_connection_is_mended_too():
    link = Brittle(failures=2)
    env = Slow(link, {"state": ("speed",)}, ("force",), ENDLESS.actions, period=0.01, sample="sample")
    row = env.reset()
    for _ in range(100):
        row = env.step(row.set("action", torch.tensor([ASKED]).double()))["next"]
        if link.connections > 2 and row["state"].isfinite().all():
            break
    assert row["state"].tolist() == [1.0] and (link.connections, env.losses) == (3, 2)
    env.close()


# The recipes around the served turbine, in small: they end, and their results say what happened.


PACE = 5.0  # a period of 0.1 s, for a machine that does other things too


@pytest.mark.nightly
def test_a_served_turbine_is_trained_on_while_it_operates(tmp_path):
    module = recipe("served_turbine")
    usual = module.Config().defaults()
    config = dataclasses.replace(
        usual, quick=True, horizon=60.0, pace=PACE, port=free_port(), threads=1, log_dir=tmp_path, figures=False
    )
    module.main(dataclasses.replace(config))
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    versions = [record["version"] for record in metrics["episodes"]]
    assert len(versions) == 3 and versions == sorted(versions) and versions[-1] >= 1.0
    assert all(0.0 < record["late_median"] < 100.0 for record in metrics["episodes"])


@pytest.mark.nightly
def test_an_exported_policy_acts_on_the_served_turbine(tmp_path):
    config, parts = leave_run(tmp_path / "run", "wind_turbine")
    export_program(parts["model_based"], tmp_path / "law.pt2", physics_of(config))
    module = recipe("served_turbine")
    options = {"act": tmp_path / "law.pt2", "trusted": True, "observe": config.observe, "horizon": 20.0, "pace": PACE}
    module.main(module.Config(**options, port=free_port(), log_dir=tmp_path / "service"))
    results = json.loads((tmp_path / "service" / "in_service.json").read_text())
    assert results["intervals"] == 40.0 and results["lost_connections"] == 0.0 and results["J_a"] > 0.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pace": 0.0}, "pace="),
        ({"port": 0}, "port="),
        ({"real": "rosco"}, "real='rosco' is another real system"),
        ({"unknown": ("pitch",)}, "unknown=.*'pitch'.* is another real system"),
        ({"model_error": True}, "model_error=True is another real system"),
        ({"serve": True, "connect": True}, "serve=True runs the server alone"),
        ({"serve": True, "act": "law.onnx"}, "serve=True runs the server alone"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        recipe("served_turbine").Config(**options)


# What the page "Connect your machine" prints: its example makes a real system that has not connected yet.


def test_the_example_makes_a_real_system_that_connects_at_its_reset():
    pytest.importorskip("asyncua")
    pytest.importorskip("pymodbus")
    code, modbus = blocks("connect_your_machine.md", "python")
    names = {}
    exec(modbus, names)
    assert isinstance(names["link"], ModbusLink)
    exec(code.replace("opc.tcp://rig:4840", f"opc.tcp://127.0.0.1:{free_port()}"), names)  # nobody listens there
    system = names["machine"]()
    assert isinstance(system, RealSystem) and system.pace.period == system.plant.dt == 0.05
    client = system.env.env
    assert client.losses == 0
    with pytest.raises(LinkLostError):
        client.link.read()
    low, high = system.env.limits.low, system.env.limits.high
    assert torch.equal(low, -high)
    client.link.close()
