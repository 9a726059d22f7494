"""Faults of the real system: what is kept of the episode, what the record says, and that the training goes on."""

import json

import pytest
import torch
from faulty_system import FaultySystem, Injection
from linear_quadratic import LinearQuadratic
from small_runs import SMALL
from test_algorithm import twinning

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.steps.config import RefereeConfig
from rt_torchrl.systems.config import SafetyConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.safety import SafetyLayer

DT, N = 0.1, 40
WATCHED = {
    "ranges": {"state": (-50.0, 50.0)},
    "clock": "time",
    "frozen": {"state": 2},
    "following": (0.01,),
    "deadline": 0.5,
}


class Wait:
    """A clock and a sleep that take no time."""

    now = 0.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def guarded(*injections, plant=None, **options):
    plant, wait = plant or LinearQuadratic(horizon=DT * N), Wait()
    system = FaultySystem(PlantEnv(plant, seed=0), injections, interval=plant.dt, sleep=wait.sleep)
    config = SafetyConfig(interval=plant.dt, **WATCHED | options)
    return SafetyLayer(system, config, fallback=(0.0,), clock=wait)


def algorithm(env, **changes):
    changes = {"referee": RefereeConfig(rule="decision_tree")} | changes
    parts = twinning(LinearQuadratic(horizon=DT * N), **changes)
    generator = torch.Generator().manual_seed(0)
    return ReinforcementTwinning(env, parts.twin, config=parts.config, generator=generator, **parts.policies)


def faulty(kind, first=8, last=None, episode=1, **options):
    return Injection(kind=kind, first=first, last=last, episode=episode, **options)


# The fault, what the layer calls it, and the intervals that are lost by it.
SENSORS = [
    (faulty("dropped"), "missing", {8, 9}),
    (faulty("repeated"), "clock", {8, 9}),
    (faulty("nan", 8, 10), "not finite", {8, 9, 10, 11}),
    (faulty("out_of_range", value=80.0), "out of range", {8, 9}),
    (faulty("frozen", 8, 12), "frozen", set(range(8, 14))),
    (faulty("clock_jump", value=3600.0), "clock", {8, 9}),
    (faulty("late", value=0.6), "late", set()),
    (faulty("stuck_actuator", 8, 20), "actuator", set()),
    (faulty("slow_actuator", 8, 20, value=0.3), "actuator", set()),
]


@pytest.fixture(scope="module")
def sound():
    """The transitions of two episodes without a fault."""
    found = algorithm(guarded())
    found.episode(), found.episode()
    assert len(found.learner.memory) == 2 * N
    return found.learner.memory.buffer[:]


@pytest.mark.parametrize(("injection", "kind", "lost"), SENSORS, ids=lambda value: getattr(value, "kind", None))
def test_the_sound_part_is_kept_and_the_training_goes_on(injection, kind, lost, sound):
    """The oracle is the same system without the fault, up to the fault: what is kept are its transitions."""
    found = algorithm(guarded(injection))
    found.episode()
    report = found.episode()
    # A reading that comes twice also shows an actuator that does not follow, and a sensor that stands still.
    assert {fault.kind for fault in found.flights.faults} - {kind} <= (
        {"actuator", "frozen"} if kind == "clock" else set()
    )
    at = next(fault for fault in found.flights.faults if fault.kind == kind)
    assert at.interval in range(8, 10) and at.time == pytest.approx(at.interval * DT)
    assert report[f"faults/{kind}"] == 1
    assert len(found.learner.memory) == 2 * N - len(lost)
    buffer = found.learner.memory.buffer[:]
    assert torch.equal(buffer[: N + 8]["observation"], sound[: N + 8]["observation"])
    assert all(value.abs().max() < 50.0 for value in buffer.select("observation", "action").values())
    record = found.short_term[-1]
    first = max(lost) + 1 if lost else 0
    assert len(record.actions) == N - first and record.start == pytest.approx(first * DT)
    # The record is what the plant did under what its actuators did.
    plant = found.twin.plant
    t = record.start + DT * torch.arange(len(record.actions), dtype=torch.float64)
    ends = plant.step(t, record.states[:-1], record.actions, record.exogenous, plant.closure).state
    torch.testing.assert_close(ends, record.states[1:], rtol=0, atol=1e-12)
    assert found.episode()["real_cost"].isfinite()


@pytest.mark.parametrize("kind", ["raises", "ends_early"])
@pytest.mark.parametrize("records", [1, 3])
def test_an_episode_that_ends_early_is_kept_up_to_there(kind, records):
    found = algorithm(guarded(faulty(kind, 25), faulty(kind, 30, episode=2)), records=records)
    found.episode()
    for kept in (25, 30):
        report = found.episode()
        kept += kind == "ends_early"  # what the system reports with its end counts
        assert report["sound_intervals"] == kept and len(found.short_term[-1].actions) == kept
        assert [fault.kind for fault in found.flights.faults] == ["ended"]
        assert found.flights.faults[0].time == pytest.approx(kept * DT)
        assert report["J_p"].isfinite() and report["J_a_model_based"].isfinite()
    assert "sound_intervals" not in found.episode() and len(found.belief.flown) == 2


def test_too_little_of_an_episode_is_flown_again():
    found = algorithm(guarded(faulty("raises", 12), faulty("nan", 0, 39, episode=2)))
    found.episode()
    report = found.episode()
    assert report["episodes_refused"] == 2 and "sound_intervals" not in report
    assert [fault.kind for fault in found.flights.faults] == ["ended", "not finite"]
    assert len(found.learner.memory) == 2 * N


def test_the_first_episode_is_whole():
    found = algorithm(guarded(faulty("raises", 38, episode=0)))
    assert found.episode()["episodes_refused"] == 1 and len(found.short_term[-1].actions) == N
    alone = algorithm(guarded(faulty("raises", 38, episode=0)), arm="model_free")
    assert alone.episode()["sound_intervals"] == 38


@pytest.mark.parametrize("figures", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_real_fault_is_in_the_record_and_on_the_dashboard(tmp_path, figures):
    plant = LinearQuadratic(horizon=DT * N)
    config = RunConfig(
        episodes=3, log_dir=tmp_path, compiled=False, unseen=2, untrained=0, figures=figures, twinning=SMALL
    )
    run = Run(config, plant)
    run.algorithm.env = None
    system = guarded(faulty("nan", 8, 10), faulty("raises", 30, episode=2), plant=plant)
    run.algorithm = algorithm_of(run, system)
    episodes = run.train()["episodes"]
    assert "faults" not in episodes[0]
    assert [(fault["kind"], fault["interval"]) for fault in episodes[1]["faults"]] == [("not finite", 8)]
    assert episodes[2]["faults"][0]["time"] == pytest.approx(3.0) and episodes[2]["sound_intervals"] == 30
    assert json.loads((tmp_path / "metrics.json").read_text())["episodes"] == episodes
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    shown = EventAccumulator(str(tmp_path))
    shown.Reload()
    assert [event.value for event in shown.Scalars("faults/not finite")] == [1.0]
    (text, *_) = shown.Tensors("faults/text_summary")
    assert b"| 0.8 | not finite |" in text.tensor_proto.string_val[0]


def algorithm_of(run, system):
    made = run.algorithm
    return ReinforcementTwinning(
        system,
        made.twin,
        model_free=made.policies["model_free"],
        model_based=made.policies["model_based"],
        config=made.config,
        generator=made.generator,
    )
