"""Recorded logs: columns and units, what is refused, what the recorder writes, and logs at control intervals."""

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

from rt_torchrl import AssimilationConfig, DigitalTwin, LaggedActuator, Rollout, StackedObservations
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.fit.least_squares import Estimation, EstimationConfig, autocorrelation
from rt_torchrl.fit.log import Column, SensorLog, checked, read_log
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
PLANT = LinearQuadratic(dt=0.1)
TABLE = "t,x_mm,velocity,force,disturbance,note\n0,1000,0.1,1,0,a\n100,2000,0.2,1,0,b\n250,3000,0.3,-1,0.5,c\n"
MAPPING = [Column.parse("t=time*0.001"), Column.parse("x_mm=position*1e-3+2")]


def signals(times, **columns):
    """A log of the oracle plant; columns that are not given are zero."""
    times = np.asarray(times, dtype=float)
    zero = dict.fromkeys(("position", "velocity", "force", "disturbance"), np.zeros_like(times))
    return SensorLog(times=times, columns=zero | columns)


def jittered(n, dt=0.1, seed=0):
    times = dt * (np.arange(n) + 0.6 * (np.random.default_rng(seed).random(n) - 0.5))
    return times - times[0]


@pytest.mark.parametrize(
    "text, expected",
    [
        ("omega=rotor_speed", ("omega", "rotor_speed", 1.0, 0.0, None)),
        ("T [C]=wall_temperature+273.15", ("T [C]", "wall_temperature", 1.0, 273.15, None)),
        ("p=pressure*1e5-2.5", ("p", "pressure", 1e5, -2.5, None)),
        ("a=b=force*-1e-3+1e2", ("a=b", "force", -1e-3, 1e2, None)),
        ("T [C]=wall_temperature[°C]", ("T [C]", "wall_temperature", 1.0, 0.0, "°C")),
        ("a=b=flow[m^3/s]", ("a=b", "flow", 1.0, 0.0, "m^3/s")),
    ],
)
def test_columns_are_declared_with_a_unit_or_factor_and_offset(text, expected):
    assert Column.parse(text) == expected


def test_columns_are_converted_by_their_units(tmp_path):
    (tmp_path / "log.csv").write_text(TABLE)
    columns = [Column.parse(text) for text in ("t=time[ms]", "x_mm=position[mm]", "velocity=velocity[km/h]")]
    log = checked(read_log(tmp_path / "log.csv", PLANT, columns), PLANT)
    assert log.times.tolist() == pytest.approx([0.0, 0.1, 0.25])
    assert log.columns["position"].tolist() == pytest.approx([1.0, 2.0, 3.0])
    assert log.columns["velocity"].tolist() == pytest.approx([0.1 / 3.6, 0.2 / 3.6, 0.3 / 3.6])
    assert read_log(tmp_path / "log.csv", PLANT, MAPPING).columns["position"].tolist() == [3.0, 4.0, 5.0]
    tank = CryogenicTank()
    (tank_log := tmp_path / "tank.csv").write_text("time,T,p\n0,-40,1.5\n1,32,2\n")
    read = read_log(tank_log, tank, [Column.parse("T=wall_temperature[°F]"), Column.parse("p=pressure[kPa]")])
    assert read.columns["wall_temperature"].tolist() == pytest.approx([233.15, 273.15], rel=1e-13)
    assert read.columns["pressure"].tolist() == pytest.approx([1500.0, 2000.0], rel=1e-13)


@pytest.mark.parametrize("name, index", [("log.CSV", None), ("log.parquet", None), ("log.Parquet", "time")])
def test_what_is_written_is_read_again(tmp_path, name, index):
    """Also where the time is the index of a table."""
    pd, path, times = pytest.importorskip("pandas"), tmp_path / name, jittered(20)
    if name != "log.CSV":
        pytest.importorskip("pyarrow")
    log = signals(times, position=np.sin(times), force=np.cos(times))
    log.write(path)
    if index:
        pd.read_parquet(path).set_index(index).to_parquet(path)
    again = read_log(path, PLANT)
    # Decimal digits of the shortest form that is read back, to rounding of the parser.
    np.testing.assert_allclose(again.times, log.times, rtol=1e-15)
    for name, values in log.columns.items():
        np.testing.assert_allclose(again.columns[name], values, rtol=1e-15)


def test_dates_are_counted_from_the_first_row(tmp_path):
    rows = ["2024-03-31 00:59:59.5+01:00", "2024-03-31 03:00:00+02:00", "2024-03-31T01:00:02Z"]
    text = "time,force,disturbance\n" + "".join(f"{row},0,0\n" for row in rows)
    (tmp_path / "log.csv").write_text(text)
    # The clocks were put forward in between: 23:59:59.5, 1:00:00 and 1:00:02 UTC.
    assert read_log(tmp_path / "log.csv", PLANT).times.tolist() == [0.0, 3600.5, 3602.5]


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", ",\n"),
        lambda text: text.replace("\n", ",\n", 1),  # the header alone has one
        lambda text: text.replace("0.1,", "0.1 , "),
        lambda text: text.replace("velocity", '" velocity "').replace("time", "\ufefftime "),
        lambda text: "\n" + text.replace("\n", "\n\n"),
    ],
)
def test_columns_are_as_the_header_says(tmp_path, change):
    table = "time,position,velocity,force,disturbance\n0,1,0.1,1,0\n0.1,2,0.2,1,0.25\n0.2,3,0.3,-1,0.5\n"
    (tmp_path / "log.csv").write_text(change(table), encoding="utf-8")
    log = read_log(tmp_path / "log.csv", PLANT)
    assert log.times.tolist() == [0.0, 0.1, 0.2]
    found = {name: values.tolist() for name, values in log.columns.items()}
    assert found["position"] == [1.0, 2.0, 3.0] and found["velocity"] == [0.1, 0.2, 0.3]
    assert found["force"] == [1.0, 1.0, -1.0] and found["disturbance"] == [0.0, 0.25, 0.5]


def test_bad_rows_become_gaps_on_demand():
    force = np.zeros(100)
    force[[30, 31, 32, 33, 60]] = [3.0, np.nan, 3.0, 3.0, np.inf]
    log = checked(signals(0.1 * np.arange(100), force=force), PLANT, drop=True)
    assert len(log.times) == 95
    parts = resample(log, PLANT)
    # A pause of one row is shorter than three intervals, but nobody knows what the force was in it.
    assert [len(segment.actions) for segment in parts.segments] == [29, 25, 38]
    assert np.allclose(parts.gaps, [(2.9, 3.4), (5.9, 6.1)])
    # The longest pause that is bridged is of rows that were never there.
    assert [len(segment.actions) for segment in resample(log, PLANT, gap=9.0).segments] == [29, 25, 38]


def test_cuts_stay_where_a_log_is_cut_again():
    log = signals(0.1 * np.arange(10))
    once = log.chosen(np.array([k not in (0, 3, 4, 9) for k in range(10)]))  # 1 2 | 5 6 7 8
    assert log.cuts == () and once.cuts == (2,) and once.without(["velocity"]).cuts == (2,)
    assert once.chosen(np.array([1, 1, 0, 1, 1, 1], dtype=bool)).cuts == (2,)
    assert once.chosen(np.array([0, 1, 1, 1, 0, 1], dtype=bool)).cuts == (1, 3)
    assert once.chosen(np.array([0, 0, 1, 1, 1, 1], dtype=bool)).cuts == ()


def test_the_turbine_completes_its_filters():
    """The plant completes its states from the rotor speed alone; they equal those of its own integration."""
    plant = WindTurbine(horizon=120.0)
    generator = torch.Generator().manual_seed(1)
    wind = plant.draw_exogenous(1, generator)
    start = plant.draw_initial_state(1, generator)
    start[:, 2] = wind[:, 0, 0]  # settled, as the completion takes it
    start[:, 3] = plant.speed_error(start[:, 1], start[:, 2])
    torque = 25e3 + 1e3 * torch.sin(0.1 * torch.arange(plant.n_steps))
    command = torch.stack([torque, torch.zeros_like(torque)], -1)[None].double()
    with torch.no_grad():
        flown = Rollout(plant, plant.closure)(start, wind, command)
    found = plant.complete_states({"rotor_speed": flown.states[0, :, 0]}, wind[0], flown.actions[0])
    # The mean of both ends is the integral to second order: (Δt/T)²/12 of what a filter of 4 s or 5 s is driven by.
    scale = flown.states[0].abs().amax(0).clamp_min(1e-9)
    error = (found - flown.states[0]).abs()[1:] / scale
    assert (error[:, 1:4] < 2e-3).all() and (error[:, [0, 4, 5]] == 0.0).all()
    given = torch.full((plant.n_steps + 1,), 9.0, dtype=torch.float64)
    measured = {"rotor_speed": flown.states[0, :, 0], "filtered_wind_speed": given}
    assert torch.equal(plant.complete_states(measured, wind[0], flown.actions[0])[:, 2], given)


# Logs at control intervals: resampling against closed forms, states without a sensor, samples that are missing.


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
    # Half of 2 and half of 5; then the last value.
    assert hold_means(np.arange(2.0), np.array([2.0, 5.0]), np.array([0.5, 1.5, 2.5])).tolist() == [3.5, 5.0]


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


def test_a_log_need_not_begin_where_hidden_states_of_actuators_are_at_rest():
    plant = LaggedActuator(StackedObservations(LinearQuadratic(horizon=2.0), 1), "force", 0.3)
    spread = initial_spread(plant, log_of(plant, ["position", "velocity"]))
    known = [state.name for state, s in zip(plant.states, spread, strict=True) if not s]
    assert known == list(plant.controller_states) and plant.unread == 1


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


@pytest.fixture
def room_log(tmp_path):
    """The first record of the room as a file, and the class of the room beside it."""
    _, _, (record, _) = room_records()
    rows = {"time": 300.0 * np.arange(200), "air": record.readings[:200, 0]}
    rows |= {"heater": record.actions[:, 0], "outside": record.exogenous[:200, 0]}
    pd.DataFrame(rows).to_csv(tmp_path / "log.csv", index=False)
    text = Path(__file__).with_name("small_plants.py").read_text()
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
    assert re.search(r"noise +bias +bias standard error.*\nair +0\.0", capsys.readouterr().out)
    assert metrics["bias_standard_error"] == {"air": 0.0}
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
