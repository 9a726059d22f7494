"""Faults of the real system: what is kept of the episode, what the record says, and that the training goes on."""

import pytest
import torch
from faulty_system import FaultySystem, Injection, as_reported
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import Time
from small_runs import SMALL
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_algorithm import twinning
from test_classical import PD

from rt_torchrl import (
    FirstController,
    PlantEnv,
    RefereeConfig,
    Run,
    RunConfig,
    SafetyConfig,
    SafetyLayer,
    shipped_plants,
)
from rt_torchrl.systems.sound_part import GREATEST

DT, N = 0.1, 40


def guarded(*injections, plant=None, **options):
    """A plant with these faults behind a layer that watches for them; all components but the first may rest."""
    plant, wait = plant or LinearQuadratic(horizon=DT * N), Time()
    system = FaultySystem(PlantEnv(plant, seed=0), injections, sleep=wait.sleep)
    moving = (3, *[0] * (len(plant.readings) - 1))
    watched = {"ranges": {"state": (-1e8, 1e8)}, "frozen": {"state": moving}, "deadline": 0.5}
    middle = tuple(0.5 * (action.low + action.high) for action in plant.actions)
    made = SafetyLayer(system, SafetyConfig(interval=plant.dt, **watched | options), fallback=middle)
    made.clock = wait
    return made


def algorithm(env, **changes):
    changes = {"referee": RefereeConfig(rule="decision_tree")} | changes
    return twinning(LinearQuadratic(horizon=DT * N), env=env, **changes)


def require_true(plant, record, *, rtol=0.0, atol=1e-12):
    """The record is what the plant did under what its actuators did."""
    t = record.start + plant.dt * torch.arange(len(record.actions), dtype=torch.float64)
    ends = plant.step(t, record.states[:-1], record.actions, record.exogenous, plant.closure).state
    torch.testing.assert_close(ends, record.states[1:], rtol=rtol, atol=atol)


# The fault, what the layer calls it, and the intervals that are lost by it.
SENSORS = [
    (Injection("dropped"), "missing", {8, 9}),
    (Injection("nan", 8, 10), "not finite", {8, 9, 10, 11}),
    (Injection("out_of_range", value=1e9), "out of range", {8, 9}),
    (Injection("frozen", 8, 12), "frozen", set(range(8, 14))),
    (Injection("late", value=0.6), "late", set()),
]
ACTUATORS = [  # whose actions nobody watches: the record holds what was applied
    (Injection("stuck_actuator", 8, 20), None, set()),
    (Injection("slow_actuator", 8, 20, value=0.3), None, set()),
]
SYSTEMS = [
    (Injection("raises", 30), "ended", set(range(30, N))),
    (Injection("ends_early", 30), "ended", set(range(31, N))),  # what the system reports with its end counts
]


@pytest.fixture(scope="module")
def sound():
    """The transitions of two episodes without a fault."""
    found = algorithm(guarded())
    found.episode(), found.episode()
    assert len(found.learner.memory) == 2 * N
    return found.learner.memory.buffer[:]


@pytest.mark.parametrize(
    ("injection", "kind", "lost"), SENSORS + ACTUATORS, ids=lambda value: getattr(value, "kind", None)
)
def test_the_sound_part_is_kept_and_the_training_goes_on(injection, kind, lost, sound):
    """The oracle is the same system without the fault, up to the fault: what is kept are its transitions."""
    found = algorithm(guarded(injection))
    found.episode()
    report = found.episode()
    assert {fault.kind for fault in found.flights.faults} == ({kind} if kind else set())
    for at in found.flights.faults:
        assert at.interval in range(8, 10) and at.time == pytest.approx(at.interval * DT)
        assert report[f"faults/{kind}"] == 1
    assert len(found.learner.memory) == 2 * N - len(lost)
    buffer = found.learner.memory.buffer[:]
    assert torch.equal(buffer[: N + 8]["observation"], sound[: N + 8]["observation"])
    assert all(value.abs().max() < 50.0 for value in buffer.select("observation", "action").values())
    record = found.short_term[-1]
    first = max(lost) + 1 if lost else 0
    assert len(record.actions) == N - first and record.start == pytest.approx(first * DT)
    require_true(found.twin.plant, record)
    assert found.episode()["real_cost"].isfinite()


@pytest.mark.parametrize("kind", ["raises", "ends_early"])
@pytest.mark.parametrize("records", [1, 3])
def test_an_episode_that_ends_early_is_kept_up_to_there(kind, records):
    found = algorithm(guarded(Injection(kind, 25), Injection(kind, 30, episode=2)), records=records)
    found.episode()
    for kept in (25, 30):
        report = found.episode()
        kept += kind == "ends_early"  # what the system reports with its end counts
        assert report["sound_intervals"] == kept and len(found.short_term[-1].actions) == kept
        assert "paired_difference" not in report  # which would be that of the last whole episode
        assert [fault.kind for fault in found.flights.faults] == ["ended"]
        assert found.flights.faults[0].time == pytest.approx(kept * DT)
        assert report["J_p"].isfinite() and report["J_a_model_based"].isfinite()
    report = found.episode()
    assert "sound_intervals" not in report and "paired_difference" in report and len(found.belief.flown) == 2


def test_faults_of_the_flight_that_a_training_begins_with_are_in_its_first_episode():
    env = guarded(Injection("late", 8, episode=0, value=0.6), Injection("raises", 30, episode=1))
    found = algorithm(env, first=FirstController(PD(LinearQuadratic(horizon=DT * N))))
    found.episode()
    assert [fault.kind for fault in found.flights.faults] == ["late", "ended"]
    found.episode()
    assert not found.flights.faults


def test_too_little_of_an_episode_is_flown_again():
    found = algorithm(guarded(Injection("raises", 12), Injection("nan", 0, 39, episode=2)))
    found.episode()
    report = found.episode()
    assert report["episodes_refused"] == 2 and "sound_intervals" not in report
    assert [fault.kind for fault in found.flights.faults] == ["ended", "not finite"]
    assert len(found.learner.memory) == 2 * N


FIRST = Injection("raises", 38, episode=0)


def test_the_first_episode_is_whole():
    found, alone = (algorithm(guarded(FIRST), arm=arm) for arm in ("twinning", "model_free"))
    assert found.episode()["episodes_refused"] == 1 and len(found.short_term[-1].actions) == N
    assert alone.episode()["sound_intervals"] == 38


@pytest.mark.parametrize("figures", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_real_fault_is_in_the_record_and_on_the_dashboard(tmp_path, figures):
    plant = LinearQuadratic(horizon=DT * N)
    config = RunConfig(episodes=3, log_dir=tmp_path, unseen=2, figures=figures, twinning=SMALL)
    system = guarded(Injection("nan", 8, 10), Injection("raises", 30, episode=2), plant=plant)
    run = Run(config, plant, env=as_reported(system, plant))
    episodes = run.train()["episodes"]
    assert "faults" not in episodes[0]
    assert [(fault["kind"], fault["interval"]) for fault in episodes[1]["faults"]] == [("not finite", 8)]
    assert episodes[2]["faults"][0]["time"] == pytest.approx(3.0) and episodes[2]["sound_intervals"] == 30
    shown = EventAccumulator(str(tmp_path))
    shown.Reload()
    assert [event.value for event in shown.Scalars("faults/not finite")] == [1.0]


STEPS = {"pendulum": 0.05, "wind_turbine": 0.25, "flapping_wing": 0.002, "cryogenic_tank": 30.0}


@pytest.mark.faults
@pytest.mark.parametrize(
    ("injection", "kind", "lost"), SENSORS + ACTUATORS + SYSTEMS, ids=lambda value: getattr(value, "kind", "")
)
@pytest.mark.parametrize("name", STEPS)
def test_every_fault_is_survived_on_every_plant(name, injection, kind, lost):
    plant = shipped_plants()[name](dt=STEPS[name], horizon=STEPS[name] * N)
    layer = guarded(injection, plant=plant)
    found = twinning(plant, env=layer, hypotheses=SMALL.hypotheses)
    reports = [found.episode() for _ in range(3)]
    kinds = [{key for key in report.keys() if key.startswith("faults/")} for report in reports]  # noqa: SIM118
    last = injection.first if injection.last is None else injection.last
    assert layer.injected == [(1, k, injection.kind) for k in range(injection.first, last + 1)]
    assert not kinds[0] and kinds[1] == ({f"faults/{kind}"} if kind else set())
    stored = found.learner.memory.buffer[:]
    assert len(stored) == 3 * N - len(lost)
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        assert (stored[key].abs() < GREATEST).all()
    assert (found.short_term[-1].states.abs() < 1e8).all() and reports[2]["real_cost"].isfinite()
    for flown in found.belief.flown:
        # Rounding, and what the actuators' own limits do twice to an action that was applied.
        require_true(plant, flown.trajectory, rtol=1e-6, atol=1e-6)
