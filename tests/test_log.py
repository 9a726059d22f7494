"""Recorded logs: columns and units, what is refused, and what the recorder writes."""

import math

import numpy as np
import pytest
import torch
from linear_quadratic import LinearQuadratic
from test_export_recipe import recipe

from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.fit.log import Column, SensorLog, checked, read_log
from rt_torchrl.fit.resampling import resample
from rt_torchrl.trajectories.rollout import Rollout

record_log = recipe("record_log")
policy_law, recorded = record_log.policy_law, record_log.recorded

pytest.importorskip("pandas")
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
    with pytest.raises(ValueError, match=r"column 'x_mm' of .* for signal 'position': unit 'kg' is none of m, cm, mm;"):
        read_log(tmp_path / "log.csv", PLANT, [columns[0], Column.parse("x_mm=position[kg]")])


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
    with pytest.raises(ValueError, match=r"or a row that was left out \(2 such places\)"):
        resample(log, PLANT, shortest=50)


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


def test_what_the_recorder_writes_of_a_plant_with_its_own_scheme():
    """The plant's own steps, without inputs; its noisy angles are read again, and in range."""
    plant = Pendulum()
    policy = plant.make_policy(torch.Generator().manual_seed(0))
    log = recorded(plant, policy_law(plant, policy), torch.Generator().manual_seed(0))
    start = plant.draw_initial_state(1, torch.Generator().manual_seed(0))
    with torch.no_grad():
        flown = Rollout(plant, plant.closure, policy)(start, torch.zeros(1, plant.n_steps, 0).double())
    # The same steps, of an angle that was wrapped once more: rounding over 200 steps.
    for k, state in enumerate(plant.states):
        np.testing.assert_allclose(log.columns[state.name], flown.states[0, :, k].numpy(), rtol=0, atol=1e-9)
    noisy = recorded(plant, policy_law(plant, policy), torch.Generator().manual_seed(0), noise=0.05)
    assert np.abs(noisy.columns["angle"]).max() <= math.pi and checked(noisy, plant) is noisy
