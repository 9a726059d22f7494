"""Lost connections between a client and a served plant: cut off, and silent as with a cable that was pulled."""

import threading
import time

import pytest
import torch
from fault_counts import count
from linear_quadratic import LinearQuadratic
from served_plants import served

from rt_torchrl.systems.protocols.connected_plant import ConnectedPlant
from rt_torchrl.systems.protocols.link import LinkLostError
from rt_torchrl.systems.protocols.relay import Relay
from rt_torchrl.systems.protocols.served_system import served_system

PLANT = LinearQuadratic(horizon=1e3)
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


def lost_connections(protocol, losses, seed):
    """The course of a plant whose connection is lost a number of times, and the times of the losses."""
    generator = torch.Generator().manual_seed(seed)
    with served(PLANT, protocol, safe=(SAFE,), period=PERIOD) as (running, port):
        relay, course, moments = Relay(port), Course(running), []
        system = served_system(PLANT, safe=(SAFE,), protocol=protocol, port=relay.port, period=PERIOD)
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
        found = env.losses + env.late
        system.close()
        relay.close()
    return course, moments, found


def check(course, moments):
    """Every loss brings the safe action within one period of the first command that stays out."""
    for moment, following in zip(moments, [*moments[1:], course.times[-1]], strict=True):
        inside = [k for k, at in enumerate(course.times) if moment <= at < following]
        safe = [k for k in inside if course.applied[k] == SAFE]
        assert safe, "the loss has not brought the safe action"
        # The interval under way may be answered already. The next one runs under the safe action, and is noted at its
        # end: two periods, and half of one for a server that shares its core with the test.
        assert course.times[safe[0]] - moment <= 2.5 * PERIOD
        assert {course.applied[k] for k in inside} <= {SAFE, ASKED}


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["modbus", pytest.param("opcua", marks=pytest.mark.nightly)])
def test_a_lost_connection_brings_the_safe_action_and_the_run_goes_on(protocol):
    course, moments, noticed = lost_connections(protocol, 2, 0)
    check(course, moments)
    assert noticed >= 2


@pytest.mark.faults
@pytest.mark.parametrize("protocol", ["opcua", "modbus"])
def test_thirty_lost_connections_bring_the_safe_action_and_the_run_goes_on(protocol):
    what, losses = f"lost connections, {protocol}", 30
    try:
        course, moments, noticed = lost_connections(protocol, losses, 1)
        check(course, moments)
        assert noticed >= losses  # a short silence is a late answer or two, and no lost connection
    except BaseException:
        count(what, "failed", defect=True)
        raise
    for _ in moments:
        count(what, "safe action in time, the run went on")


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
    env = Slow(link, {"state": ("speed",)}, ("force",), PLANT.actions, period=0.01, sample="sample")
    row = env.reset()
    for _ in range(100):
        row = env.step(row.set("action", torch.tensor([ASKED]).double()))["next"]
        if link.connections > 2 and row["state"].isfinite().all():
            break
    assert row["state"].tolist() == [1.0] and (link.connections, env.losses) == (3, 2)
    env.close()
