"""A plant behind OPC UA and Modbus, lost connections, and the recipes and the page that connect to one."""

import contextlib
import dataclasses
import json
import math
import multiprocessing
import os
import threading
import time
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import served_turbine
import torch
from linear_quadratic import LinearQuadratic
from printed_commands import blocks, run_code
from relay import Relay
from seeds_and_numbers import Time, drawn
from served_plants import free_port, served, served_turbine_alone
from served_turbine import ServedPlant, machine
from tensordict import TensorDict

import rt_torchrl as rt
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController

PLANT = LinearQuadratic(horizon=2.0)
TAGS = ServedPlant(PLANT, (0.0,))
ENTRIES, COMMANDS = TAGS.entries, TAGS.written[:-1]
PROTOCOLS = [pytest.param("opcua", marks=pytest.mark.slow), "modbus"]  # a server of OPC UA starts in seconds


def test_a_served_plant_is_a_rollout_under_the_commands_that_answer_its_samples():
    plant = ServedPlant(PLANT, (0.0,), seed=3)
    asked = torch.linspace(-2.0, 2.0, PLANT.n_steps).double()
    states = []
    for k, command in enumerate(asked.tolist()):
        states.append([plant.published()[f"state.{state.name}"] for state in PLANT.states])
        plant.advance([command], float(k + 1))
    start, inputs = drawn(PLANT, 1, 3)
    expected = rt.Rollout(PLANT, PLANT.closure)(start, inputs, asked[None, :, None])
    torch.testing.assert_close(torch.tensor(states).double(), expected.states[0, :-1].detach())
    assert plant.sample == PLANT.n_steps + 1 and not torch.equal(plant._inputs, inputs)


@pytest.mark.parametrize("wrong", [(2, 1.0), (3, math.nan), (3, math.inf), (3, 2.001)])
def test_a_command_that_is_missing_or_wrong_brings_the_safe_action_in_its_interval(wrong):
    plant, applied = ServedPlant(PLANT, (-0.5,)), []
    for answered, command in [(1, 1.0), (2, 1.5), wrong, wrong, wrong, (6, 1.0)]:
        plant.advance([command], float(answered))
        applied.append(plant.published()["applied.force"])
    assert applied == [1.0, 1.5, -0.5, -0.5, -0.5, 1.0]


class Line:
    """A link to a served plant on a simulated clock: down between some times [s], or failing at numbered requests."""

    def __init__(self, time, period, down=(), fails=None):
        self.time, self.period, self.down, self.fails, self.requests = time, period, down, fails or {}, Counter()
        self.plant, self.quality = ServedPlant(PLANT, (0.0,)), {}
        self.answer = {"answered": math.nan, "command.force": math.nan}

    def _up(self, request):
        self.requests[request] += 1
        if (request, self.requests[request]) in self.fails:
            raise self.fails[request, self.requests[request]]
        while self.plant.sample * self.period <= self.time.now + 1e-12:
            self.plant.advance([self.answer["command.force"]], self.answer["answered"])
        if any(begin <= self.time.now < end for begin, end in self.down):
            raise rt.LinkLostError("down")

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
    named = {"sample": "sample", "answered": "answered"}
    env = rt.ConnectedPlant(line, entries, COMMANDS, PLANT.actions, period=line.period, **named, **options)
    env.pace.clock, env.pace.sleep = line.time, line.time.sleep
    return env


def test_a_client_answers_every_sample_of_the_plant():
    line = Line(Time(), 0.1)
    env = connected(line)
    found = env.rollout(50, lambda td: td.set("action", torch.ones(1).double()))
    assert env.losses == found["next", "skipped"].sum() == 0
    assert (found["next", "applied"] == 1.0).all()
    assert line.time.now == pytest.approx(5.0, rel=0.02)
    line.time.now += 5.0  # between two episodes nobody reads
    assert env.reset()["skipped"].item() == 0
    line.time.now += 0.35
    env.step(env.step_mdp(found[-1]).set("action", torch.ones(1).double()))
    late = env.pace.late
    env.reset()
    assert late > 0.2 and env.pace.late == 0.0  # the first interval is due at once


def test_a_client_keeps_its_period_while_the_line_is_down_and_goes_on_afterwards():
    line = Line(Time(), 0.1, down=[(1.05, 1.85)])
    env = connected(line)
    row, lost, times = env.reset(), [], []
    for _ in range(40):
        row = env.step(row.set("action", torch.tensor([1.0]).double()))["next"]
        lost.append(bool(row["state"].isnan().any()))
        times.append(line.time.now)
        if env._connecting is not None and line.time.now >= 1.85:
            env._connecting.exception()
    assert env.losses == 1 and 8 <= sum(lost) <= 10 and lost.index(True) in (9, 10) and not any(lost[22:])
    # The period is kept: no step takes longer than one and a half of it, for the first look after the loss.
    assert max(b - a for a, b in zip(times, times[1:], strict=False)) <= 0.15 + 1e-9
    assert row["applied"].item() == 1.0
    env.close()


def test_a_plant_that_never_answers_is_said_in_a_sentence():
    line = Line(Time(), 0.1, down=[(0.0, math.inf)])
    with pytest.raises(ValueError, match="the plant has not answered for 60 s: down"):
        connected(line).reset()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_plant_behind_a_protocol_does_what_its_twin_computes(protocol):
    """States, inputs and applied actions as they came over the line are a step of the plant, to the last digit."""
    pytest.importorskip({"opcua": "asyncua", "modbus": "pymodbus"}[protocol])
    with served(PLANT, protocol, safe=(0.0,), period=0.05) as (running, port):
        system = machine(PLANT, (0.0,), protocol, port, 0.05)
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
    whole = ~flown["next", "refused"].flatten()
    whole[1:] &= whole[:-1].clone()  # a busy machine may miss a sample
    torch.testing.assert_close(ends[whole], flown["next", "state"][whole], rtol=1e-12, atol=1e-12)


# Lost connections between a client and a served plant: cut off, and silent as with a cable that was pulled.


ENDLESS = LinearQuadratic(horizon=1e3)
PERIOD = 0.05
SAFE, ASKED = -0.5, 1.0


class Course:
    """What the plant has applied, sample by sample, and when; written by the plant's own thread."""

    def __init__(self, running):
        self.applied, self.times = [], []
        advance = running.advance

        def watched(command, answered):
            advance(command, answered)
            self.applied.append(running.published()["applied.force"])
            self.times.append(time.monotonic())

        running.advance = watched


def acting(system, row, steps):
    for _ in range(steps):
        row = system.step_mdp(system.step(row.set("action", torch.tensor([[ASKED]]).double())))
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
        system = machine(ENDLESS, (SAFE,), protocol, relay.port, PERIOD)
        row = acting(system, system.reset(), 10)
        for k in range(losses):
            seconds = PERIOD * (2.0 + 4.0 * torch.rand((), generator=generator).item())
            moments.append(time.monotonic())
            (relay.cut if k % 2 else relay.stall)(seconds)
            row = acting(system, row, 8)
            for _ in range(100):  # until the plant follows again
                if course.applied[-1] == ASKED and not row["refused"].any():
                    break
                row = acting(system, row, 1)
            assert course.applied[-1] == ASKED, f"the run does not go on after loss {k}"
            row = acting(system, row, 2)
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


# The recipe of the served turbine, in small.


PACE = 5.0  # a period of 0.1 s, for a machine that does other things too


@pytest.mark.nightly
def test_a_served_turbine_is_trained_on_while_it_operates(tmp_path):
    config = served_turbine.Config().defaults()
    options = {"quick": True, "horizon": 60.0, "pace": PACE, "threads": 1, "log_dir": tmp_path, "figures": False}
    config = dataclasses.replace(config, **options)
    with served_turbine_alone(pace=PACE, horizon=config.horizon) as port:
        served_turbine.main(dataclasses.replace(config, port=port))
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    versions = [record["version"] for record in metrics["episodes"]]
    assert len(versions) == 3 and versions == sorted(versions) and versions[-1] >= 1.0
    assert all(0.0 < record["late_median"] < 100.0 for record in metrics["episodes"])


# What the page "Connect your machine" prints: its example makes a real system that has not connected yet.


def test_the_example_makes_a_real_system_that_connects_at_its_reset():
    pytest.importorskip("asyncua")
    pytest.importorskip("pymodbus")
    code, modbus = blocks("connect_your_machine.md", "python")
    nobody = code.replace("opc.tcp://rig:4840", f"opc.tcp://127.0.0.1:{free_port()}")
    names = run_code("connect_your_machine.md", nobody, **run_code("connect_your_machine.md", modbus))
    system = names["machine"]()
    assert isinstance(names["link"], rt.ModbusLink) and system.pace.period == system.plant.dt == 0.05
    with pytest.raises(rt.LinkLostError):
        system.env.env.link.read()
    system.env.env.link.close()


# Minutes of operation on the wall clock, by ``-m machine``: lost connections while it learns.


SECONDS = float(os.environ.get("SECONDS_OF_A_MACHINE_TEST", "120"))
SEEN = 1.0
"""Time after its end within which a lost connection is in the log [s]."""


def handles(pid):
    return len(os.listdir(f"/proc/{pid}/fd"))


def memory(pid):
    """Resident memory of a process [MiB]."""
    (line,) = (line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS"))
    return float(line.split()[1]) / 1024.0


def lose(relay, ended, lost):
    """Lose connections at random times: half of them are cut, half are silent."""
    draws = np.random.default_rng(0)
    while not ended.wait(draws.exponential(10.0)):
        kind, seconds = str(draws.choice(["cut", "stall"])), float(draws.uniform(0.1, 2.0))
        lost.append((time.time(), seconds))
        getattr(relay, kind)(seconds)


@pytest.mark.machine
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="memory and file handles are read from /proc")
def test_a_soak_logs_every_lost_connection_and_keeps_memory_and_handles(tmp_path):
    pytest.importorskip("pymodbus")
    log, config = tmp_path / "safety.jsonl", served_turbine.Config().defaults()
    operation = {"asynchronous": True, "operation": rt.OperationConfig(continuous=True)}
    config = dataclasses.replace(config, horizon=60.0, threads=1, log_dir=tmp_path / "run", **operation)
    plant, period, ended, lost, used = config.plant(), config.dt / PACE, threading.Event(), [], []
    with served_turbine_alone(pace=PACE, horizon=60.0) as port, contextlib.closing(Relay(port)) as relay:
        env = partial(machine, plant, served_turbine.SAFE, "modbus", relay.port, period, log=log)
        run = rt.Run(config, plant, env=env, first=JonkmanController)
        algorithm, until = run.algorithm, float("inf")
        losing = threading.Thread(target=lose, args=(relay, ended, lost), daemon=True)
        try:
            while time.monotonic() < until:
                with contextlib.suppress(ValueError):  # several windows in a row may be cut up
                    assert algorithm.episode()["real_cost"].isfinite()
                if not used:  # the first round, which compiles, may take long
                    losing.start()
                    until = time.monotonic() + SECONDS
                pids = [os.getpid(), *sorted(process.pid for process in multiprocessing.active_children())]
                used.append([(memory(pid), handles(pid)) for pid in pids])
        finally:
            ended.set()
            algorithm.operating.operation.close()
            run._held.release()
    times = np.array([json.loads(line)["at"] for line in log.read_text().splitlines()])
    logged = [bool(((times >= at) & (times <= at + seconds + SEEN)).any()) for at, seconds in lost]
    assert len(lost) >= 3 and all(logged[:-1])  # the last one may outlive the run
    kept = np.array(used[len(used) // 4 :])
    assert (kept[-1, :, 1] <= kept[0, :, 1] + 2).all() and (kept[-1, :, 0] <= 1.1 * kept[0, :, 0]).all()
