"""Logs at control intervals: resampling against closed forms, states without a sensor, samples that are missing."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from small_plants import Envelope, Room, room_records
from test_export_recipe import recipe
from test_log import PLANT, jittered, signals

from rt_torchrl import AssimilationConfig, DigitalTwin, Rollout
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.fit import resampling
from rt_torchrl.fit.least_squares import Estimation, EstimationConfig, autocorrelation
from rt_torchrl.fit.log import SensorLog, checked
from rt_torchrl.fit.resampling import (
    filled,
    hidden_states,
    hold_means,
    hold_out,
    initial_spread,
    logged_readings,
    resample,
    sensors_in,
)
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.steps.hypotheses.assimilation import reread

pd = pytest.importorskip("pandas")


def test_instantaneous_signals_are_interpolated():
    """A line is exact; a sine has an error of at most h²/8 times its curvature, with h the longest interval."""
    times = jittered(200)
    log = signals(times, position=2.0 - 0.3 * times, velocity=np.sin(times))
    (segment,) = resample(log, PLANT).segments
    t = torch.arange(len(segment.states), dtype=torch.float64) * PLANT.dt
    torch.testing.assert_close(segment.states[:, 0], 2.0 - 0.3 * t, rtol=0, atol=1e-12)
    error = (segment.states[:, 1] - t.sin()).abs().max().item()
    bound = np.diff(times).max() ** 2 / 8.0
    assert 0.2 * bound < error < bound


def test_held_signals_are_averaged_over_the_interval():
    """The means equal the integral of the steps by a fine sum."""
    times, values = jittered(50), np.random.default_rng(1).normal(size=50)
    found = hold_means(times, values, 0.1 * np.arange(45))
    fine = (np.arange(44 * 1000) + 0.5) * 1e-4
    held = values[np.searchsorted(times, fine, side="right") - 1].reshape(44, 1000).mean(-1)
    # At most two steps an interval, each up to 4 high and wrong by at most a thousandth of the interval.
    np.testing.assert_allclose(found, held, atol=8e-3)


def test_gaps_split_and_short_parts_are_left_out_and_told():
    times = np.concatenate([np.arange(0, 50), np.arange(60, 63), np.arange(80, 130)]) * 0.1
    parts = resample(signals(times), PLANT)
    assert [(round(s.start, 9), len(s.actions)) for s in parts.segments] == [(0.0, 49), (8.0, 49)]
    assert np.allclose(parts.gaps, [(4.9, 6.0), (6.2, 8.0)]) and np.allclose(parts.too_short, [(6.0, 6.2)])
    assert (parts.interval, parts.gap) == (pytest.approx(0.1), pytest.approx(0.3))
    assert parts.jitter < 1e-9
    # A longer limit bridges the first gap, a still longer one both.
    assert [len(s.actions) for s in resample(signals(times), PLANT, gap=1.2).segments] == [62, 49]
    assert [len(s.actions) for s in resample(signals(times), PLANT, gap=2.0).segments] == [129]


def test_the_end_is_held_out():
    times = np.concatenate([np.arange(0, 51), np.arange(100, 151)]) * 0.1
    segments = resample(signals(times, position=times), PLANT).segments
    training, held_out = hold_out(segments, PLANT.dt, 0.25)
    lengths = [[len(s.actions) for s in part] for part in (training, held_out)]
    assert lengths == [[50, 25], [25]]
    assert held_out[0].start == pytest.approx(12.5)
    assert held_out[0].states[0, 0] == training[1].states[-1, 0] == pytest.approx(12.5)
    # A cut that would leave five intervals moves to the end of the segment.
    assert [len(s.actions) for s in hold_out(segments, PLANT.dt, 0.45)[0]] == [50]


@pytest.mark.parametrize("counted", [False, True])
def test_a_periodic_state_is_interpolated_across_its_seam(counted):
    """A rod that turns steadily, by 0.3 rad between rows, of a sensor that wraps or counts the turns."""
    plant, times = Pendulum(), jittered(120, dt=0.05)
    turned = 3.0 + 6.0 * times
    angle = turned if counted else np.arctan2(np.sin(turned), np.cos(turned))
    columns = {"angle": angle, "angular_speed": np.full(120, 6.0), "torque": np.zeros(120)}
    log = checked(SensorLog(times=times, columns=columns), plant)
    (segment,) = resample(log, plant).segments
    found = segment.states[:, 0].numpy()
    expected = 3.0 + 6.0 * 0.05 * np.arange(len(found))
    # Linear in time: rounding of angles up to 40.
    assert np.abs(np.arctan2(np.sin(found - expected), np.cos(found - expected))).max() < 1e-12
    assert (np.abs(found) <= math.pi).all() and segment.exogenous.shape == (len(found) - 1, 0)


@pytest.mark.parametrize("unit", [1e3, 1e9])
def test_a_time_in_another_unit_is_refused_before_memory_is_taken(unit, monkeypatch):
    """Milliseconds and nanoseconds taken for seconds; of the latter the grid alone would have 10¹² points."""
    monkeypatch.setattr(resampling, "_segment", lambda *_: pytest.fail("memory is taken"))
    step = f"{0.1 * unit:g}"
    message = rf"'time' of the log has a median step of {re.escape(step)} s.*236 rows would become \d+ .*dt=0.1 s"
    with pytest.raises(ValueError, match=message):
        resample(signals(0.1 * unit * np.arange(236)), PLANT)


TESTS = Path(__file__).parent


def log_of(plant, states, rows=40):
    """A log with constants for the drive and a ramp for each of these states."""
    driven = {signal.name: np.full(rows, max(signal.low, 1.0)) for signal in (*plant.actions, *plant.inputs)}
    ramps = {name: np.linspace(1.0, 1.2, rows) for name in states}
    return SensorLog(times=plant.dt * np.arange(rows), columns=driven | ramps)


@pytest.mark.parametrize(
    "kind, states, hidden, unknown",
    [
        (WindTurbine, ["rotor_speed"], [], ["rotor_speed"]),
        (FlappingWing, ["forward_position", "height"], ["forward_speed", "climb_speed"], None),
        (CryogenicTank, ["pressure"], ["wall_temperature", "liquid_volume"], None),
    ],
)
def test_hidden_states_are_those_that_the_plant_cannot_complete(kind, states, hidden, unknown):
    plant = kind()
    log = log_of(plant, states)
    assert hidden_states(plant, log) == hidden
    free = [state.name for state, s in zip(plant.states, initial_spread(plant, log), strict=True) if s > 0.0]
    assert sorted(free) == sorted(unknown or [*states, *hidden])


def test_samples_between_rows_that_are_too_far_apart_are_missing():
    plant = Room()
    log = log_of(plant, ["air"], rows=30)
    times = log.times + np.where(np.arange(30) % 2 == 1, 60.0, 0.0)
    air = 20.0 + 1e-3 * times
    air[10:13] = np.nan  # rows 9 and 13 are 1 200 s apart, and that of row 13 lies 60 s before it
    log = checked(SensorLog(times=times, columns=log.columns | {"air": air}), plant, missing=True)
    whole = filled(log, plant, {"wall": 11.0})
    parts = resample(whole, plant)
    record = logged_readings(log, plant, sensors_in(plant, log), parts.segments[0], parts.gap)
    expected = 20.0 + 1e-3 * plant.dt * np.arange(len(record.readings))
    seen = record.seen[:, 0].numpy()
    assert np.flatnonzero(~seen).tolist() == [10, 11, 12, 13]
    np.testing.assert_allclose(record.readings[:, 0].numpy()[seen], expected[seen], rtol=1e-12)
    assert record.guess.tolist() == [20.0, 11.0] and len(record.actions) == 29


def test_no_sample_is_lost_by_the_rounding_of_unix_seconds():
    plant = LinearQuadratic(dt=5e-4, horizon=0.5)
    times = np.array([float(f"1700000000.{3700 + 5 * k}") for k in range(400)])
    rare = np.where(np.arange(400) % 20 == 0, 1.0, np.nan)
    log = checked(signals(times, position=rare), plant, missing=True)
    parts = resample(filled(log, plant), plant)
    record = logged_readings(log, plant, sensors_in(plant, log), parts.segments[0], parts.gap)
    assert np.flatnonzero(record.seen[:, 0]).tolist() == list(range(0, 400, 20)) and len(record.actions) == 399


REGULAR = signals(0.1 * np.arange(50))


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda log, plant: resample(REGULAR, PLANT, shortest=99), "no part of 99"),
        (lambda log, plant: resample(REGULAR.without(["velocity"]), PLANT), "holds no velocity"),
        (lambda log, plant: hold_out(resample(REGULAR, PLANT).segments, PLANT.dt, 0.1), "judge by"),
        (lambda log, plant: filled(log, plant, {"air": 3.0}), "guess air=3.0: .* wall"),
        (lambda log, plant: sensors_in(plant, log, ["wall"]), r"sensors=\('wall',\): the log has no column wall"),
        (lambda log, plant: sensors_in(plant, log.without(["air"])), r"sensors=\(\) of plant 'room'.* choose among"),
    ],
)
def test_what_does_not_fit_a_log_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        change(log_of(Room(), ["air"]), Room())


@pytest.fixture
def room_log(tmp_path):
    """The first record of the room as a file, and the class of the room beside it."""
    _, _, (record, _) = room_records()
    rows = {"time": 300.0 * np.arange(200), "air": record.readings[:200, 0]}
    rows |= {"heater": record.actions[:, 0], "outside": record.exogenous[:, 0]}
    pd.DataFrame(rows).to_csv(tmp_path / "log.csv", index=False)
    text = (TESTS / "small_plants.py").read_text()
    made = "    def make_closure(self, generator):\n        return Envelope(torch.tensor([30.0, 150.0, 8.0]))\n\n"
    made += "    def running_cost(self): ...\n    def draw_exogenous(self): ...\n    def observe(self): ...\n"
    text = text.replace("    observe = running_cost = draw_exogenous = make_closure = None", made)
    (tmp_path / "own_room.py").write_text(text)
    return tmp_path


def test_the_room_is_identified_from_a_file(room_log, capsys):
    identify = recipe("identify")
    given = {"log": room_log / "log.csv", "plant": f"{room_log}/own_room.py:Room", "log_dir": room_log / "results"}
    identify.main(identify.Config(**given, missing=True, guess=("wall=20",)))
    results = room_log / "results"
    metrics = json.loads((results / "metrics.json").read_text())
    weights = metrics["weights"]
    for name, true in (("to_wall", 60.0), ("outdoors", 90.0), ("capacity", 4.0)):
        entry = weights[name]
        assert abs(entry["after"] - true) < 4.0 * entry["standard_error"] < 0.2 * true
        assert entry["interval"][0] < entry["after"] < entry["interval"][1]
    assert metrics["held_out"]["rms"]["air"]["error"] == pytest.approx(0.05, rel=0.4)  # 50 samples
    assert 0.0 < metrics["initial_states"][0]["wall"][1] < 1.0
    assert re.search(r"noise.*\nair +0\.0", capsys.readouterr().out)
    closure = Envelope(torch.ones(3))
    closure.load_state_dict(torch.load(results / "weights.pt", weights_only=True)["closure"])
    assert closure.coefficients.tolist() == pytest.approx([entry["after"] for entry in weights.values()])
    assert {path.stem for path in (results / "figures").iterdir()} == {"twin_and_log", "correlations"}


def slow_log(seed=1, rows=240, noise=0.01):
    """The oscillator of the oracle at every tenth control instant, with a force held from row to row, and noise."""
    plant, generator = LinearQuadratic(horizon=1.0 * rows), torch.Generator().manual_seed(seed)
    force = torch.rand(1, rows, 1, generator=generator, dtype=torch.float64).round().repeat_interleave(10, 1) - 0.5
    start = plant.draw_initial_state(1, generator)
    with torch.no_grad():
        states = Rollout(plant, plant.closure)(start, torch.zeros_like(force), force).states[0, :-1:10]
    states = (states + noise * torch.randn(states.shape, generator=generator, dtype=torch.float64)).numpy()
    columns = {"position": states[:, 0], "velocity": states[:, 1], "force": force[0, ::10, 0].numpy()}
    log = SensorLog(times=1.0 * np.arange(rows), columns=columns | {"disturbance": np.zeros(rows)})
    return plant, log


def test_what_lies_between_the_rows_of_a_slow_log_is_no_measurement():
    plant, log = slow_log()
    parts, sensors = resample(log, plant), sensors_in(plant, log)
    record = logged_readings(log, plant, sensors, parts.segments[0], parts.gap)
    assert np.flatnonzero(record.seen.all(-1)).tolist() == list(range(0, 2391, 10))
    assert int(record.seen.sum()) == 2 * 240
    closure = LinearClosure(torch.zeros(2, 2))
    config = EstimationConfig(errors="robust")
    found = Estimation(DigitalTwin(plant, closure), sensors, config=config).run([record])
    errors = found.uncertainty.standard_errors()
    for (name, value), true in zip(found.after.items(), np.ravel(plant.true_closure), strict=True):
        assert abs(value - true) < 4.0 * errors[name] < 0.05
    assert list(found.noise.values()) == pytest.approx([0.01, 0.01], rel=0.2)
    # White noise correlates by 1/√240 = 0.065 from row to row.
    assert autocorrelation(found.likelihood).abs().max() < 0.25


@pytest.mark.parametrize("options", [{"method": "levenberg_marquardt"}, {"method": "lbfgs"}])
def test_a_training_that_begins_with_a_slow_log_compares_its_rows_alone(options):
    """Without noise the true weights are found; an interpolated sample of the oscillator is off by up to 1/8 of it."""
    plant, log = slow_log(rows=60, noise=0.0)
    (record,) = resample(log, plant).segments
    assert record.seen.nonzero().flatten().tolist() == list(range(0, 591, 10))
    closure = LinearClosure(torch.zeros(2, 2))
    config = AssimilationConfig(iterations=200, inputs="record", **options)
    found = Assimilation(DigitalTwin(plant, closure), config).update([record])
    assert found.best < 1e-8 * found.start
    torch.testing.assert_close(closure.matrix, plant.closure.matrix, rtol=0, atol=1e-3)
    short = reread(record, plant, 12).exogenous[:, -1]
    assert short.nonzero().flatten().tolist() == [0, *(10 * math.ceil(k * 1.2) for k in range(1, 49))]


def test_samples_are_not_interpolated_across_rows_that_were_left_out():
    """The air lacks its sample before the cut, so that only rows on both sides of the cut are around it."""
    plant = Room()
    log = log_of(plant, ["air"], rows=40)
    log.columns["air"][19] = np.nan
    log = log.chosen(np.arange(40) != 20)
    parts = resample(filled(log, plant), plant)
    records = [logged_readings(log, plant, sensors_in(plant, log), part, 1e9) for part in parts.segments]
    assert [len(record.readings) for record in records] == [20, 19]
    assert "gap from 5700 to 6300 s" in recipe("identify").report_of_parts(parts, plant, rows=39)
    assert records[0].readings[:, 0].isnan().nonzero().flatten().tolist() == [19] and records[1].seen.all()
