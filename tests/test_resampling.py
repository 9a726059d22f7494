"""Resampling of a log to control intervals, against closed-form signals."""

import math
import re

import numpy as np
import pytest
import torch
from test_sensor_log import PLANT, jittered, signals

from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.fit import resampling
from rt_torchrl.fit.log import SensorLog, checked
from rt_torchrl.fit.resampling import hidden_states, hold_means, hold_out, resample


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
    """The means equal the integral of the steps by a fine sum, and nothing is lost over the whole record."""
    times = jittered(50)
    values = np.random.default_rng(1).normal(size=50)
    grid = 0.1 * np.arange(45)
    found = hold_means(times, values, grid)
    fine = (np.arange(44 * 1000) + 0.5) * 1e-4
    held = values[np.searchsorted(times, fine, side="right") - 1].reshape(44, 1000).mean(-1)
    # At most two steps an interval, each up to 4 high and wrong by at most a thousandth of the interval.
    np.testing.assert_allclose(found, held, atol=8e-3)
    whole = hold_means(times, values, np.array([0.0, times[-1]]))[0]
    assert whole == pytest.approx((values[:-1] * np.diff(times)).sum() / times[-1], rel=1e-12)


def test_a_regular_log_is_taken_as_it_is():
    n = 40
    values = np.random.default_rng(2).normal(size=(2, n))
    log = signals(5.0 + 0.1 * np.arange(n), position=values[0], force=values[1])
    (segment,) = resample(log, PLANT).segments
    assert segment.start == 5.0
    # Rounding of the times.
    np.testing.assert_allclose(segment.states[:, 0].numpy(), values[0], atol=1e-11)
    np.testing.assert_allclose(segment.actions[:, 0].numpy(), values[1, :-1], atol=1e-11)


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


@pytest.mark.parametrize(
    "options, message",
    [({"gap": 0.0}, "gap=0.0"), ({"shortest": 1}, "shortest=1"), ({"shortest": 99}, "no part of 99")],
)
def test_splits_that_leave_nothing_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        resample(signals(0.1 * np.arange(50)), PLANT, **options)


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
    for share in (0.0, 1.0, math.nan):
        with pytest.raises(ValueError, match="between 0 and 1"):
            hold_out(segments, PLANT.dt, share)
    with pytest.raises(ValueError, match="judge by"):
        hold_out(segments[:1], PLANT.dt, 0.1)


def test_states_that_no_sensor_gives_are_refused_by_name():
    log = signals(0.1 * np.arange(50)).without(["velocity"])
    with pytest.raises(ValueError, match="holds no velocity"):
        resample(log, PLANT)


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


def test_a_slow_log_is_still_taken():
    """Twenty control intervals between rows are what a slow sensor gives."""
    (segment,) = resample(signals(2.0 * np.arange(20)), PLANT).segments
    assert len(segment.actions) == 380


def test_previews_follow_from_the_input_and_need_no_column():
    plant = WindTurbine(horizon=20.0, observe=("preview",))
    wind, rows = 8.0 + 0.1 * np.arange(41), {"generator_torque": 2e4, "blade_pitch": 0.0, "rotor_speed": 1.0}
    columns = {name: np.full(41, value) for name, value in rows.items()} | {"wind_speed": wind}
    log = checked(SensorLog(times=plant.dt * np.arange(41), columns=columns), plant)
    (segment,) = resample(log, plant).segments
    ahead = round(2.0 / plant.dt)
    np.testing.assert_allclose(segment.exogenous[:-ahead, 1], segment.exogenous[ahead:, 0])
    assert hidden_states(plant, log) == []
