"""A plant behind OPC UA and Modbus: the served plant, the client's environment, and both protocols between them."""

import math
import socket

import pytest
import torch
from linear_quadratic import LinearQuadratic
from served_plants import free_port, served
from tensordict import TensorDict

from rt_torchrl.systems.protocols.connected_plant import ConnectedPlant
from rt_torchrl.systems.protocols.link import LinkLostError
from rt_torchrl.systems.protocols.modbus import ModbusLink
from rt_torchrl.systems.protocols.served_plant import ServedPlant
from rt_torchrl.systems.protocols.served_system import link_to, served_system
from rt_torchrl.systems.protocols.server_process import ServerProcess
from rt_torchrl.systems.protocols.tags import ANSWERED, SAMPLE, Tags
from rt_torchrl.trajectories.rollout import Rollout

PLANT = LinearQuadratic(horizon=2.0)
TAGS = Tags.of(PLANT)
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


def test_the_safe_action_acts_before_the_first_command():
    plant = ServedPlant(PLANT, (0.25,))
    plant.advance(math.nan, [math.nan])
    assert plant.published()["applied.force"] == 0.25 and plant.safe


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
    """A link to a served plant on a simulated clock, which is down between some times [s]."""

    def __init__(self, time, period, down=()):
        self.time, self.period, self.down, self.connections = time, period, down, 0
        self.plant = ServedPlant(PLANT, (0.0,))
        self.answer = {ANSWERED: math.nan, "command.force": math.nan}

    def _up(self):
        while (self.plant.sample + 1) * self.period <= self.time.now + 1e-12:
            self.plant.advance(self.answer[ANSWERED], [self.answer["command.force"]])
        if any(begin <= self.time.now < end for begin, end in self.down):
            raise LinkLostError("down")

    def connect(self):
        self._up()
        self.connections += 1

    def read(self):
        self._up()
        return self.plant.published()

    def write(self, values):
        self._up()
        self.answer = dict(values)

    def close(self):
        pass


def connected(line, **options):
    entries = TAGS.entries
    return ConnectedPlant(
        line,
        entries,
        TAGS.commands,
        PLANT.actions,
        period=line.period,
        clock=line.time,
        sleep=line.time.sleep,
        sample=SAMPLE,
        answered=ANSWERED,
        **options,
    )


def steps(env, count, command=1.0):
    row, found = env.reset(), []
    for _ in range(count):
        row = env.step(row.set("action", torch.tensor([command]).double()))["next"]
        found.append(row)
    return found


def test_a_client_answers_every_sample_of_the_plant():
    line = Line(Time(), 0.1)
    env = connected(line)
    found = steps(env, 50)
    assert line.plant.missed == 0 and env.losses == env.stale == env.skipped == 0
    assert all(row["applied"].item() == 1.0 for row in found)
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


def test_a_plant_whose_samples_stand_still_is_not_read_as_new():
    line = Line(Time(), 0.1)
    env = connected(line)
    row = steps(env, 5)[-1]
    kept = line.plant.published()
    line.plant.published = lambda: kept
    row = env.step(row.set("action", torch.tensor([1.0]).double()))["next"]
    assert row["state"].isnan().all() and env.stale == 1 and env.losses == 0


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
    given = {"entries": TAGS.entries, "commands": TAGS.commands, "period": 0.1, **options}
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


def test_links_that_cannot_work_are_refused():
    for options, message in (
        ({"timeout": 0.0}, "timeout=0.0 s"),
        ({"read": {}}, "read={} must name registers"),
        ({"read": {"a": 0, "b": 200}}, "read spans 204 registers from 0 on"),
        ({"written": {"a": 0, "b": 8}}, "addresses one behind the other"),
    ):
        given = {"read": {"a": 0}, "written": {"b": 4}, "timeout": 0.1, **options}
        with pytest.raises(ValueError, match=message):
            ModbusLink("localhost", 1, **given)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_link_to_nobody_says_that_the_plant_does_not_answer(protocol):
    link = link_to(protocol, TAGS, free_port(), period=1.0)
    for work in (link.connect, link.read, lambda: link.write(dict.fromkeys(TAGS.written, 0.0))):
        with pytest.raises(LinkLostError):
            work()
    link.close()


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["opcua", "modbus"])
def test_a_port_in_use_is_said_without_a_traceback(protocol, capfd):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"port={port}"):
            ServerProcess(LinearQuadratic(), (0.0,), protocol=protocol, port=port, period=0.1).__enter__()
    assert "Traceback" not in capfd.readouterr().err
