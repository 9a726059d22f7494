"""What the sensors of a log read at a plant's control intervals, where some states have no sensor or lack samples."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.fit.record import SensorRecord, usual_initial_state
from rt_torchrl.fit.resampling import ROUNDING
from rt_torchrl.fit.sensor_log import SensorLog, logged_states
from rt_torchrl.fit.sensors import Sensor, known_sensors, sensors_of
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal
from rt_torchrl.trajectories.trajectory import Trajectory


def hidden_states(plant: Plant, log: SensorLog) -> list[str]:
    """States that a log does not hold, and that the plant cannot complete from those that it holds."""
    lacking = [state.name for state in logged_states(plant) if state.name not in log.columns]
    return [name for name in lacking if not _completes(plant, log, [other for other in lacking if other != name])]


def _completes(plant: Plant, log: SensorLog, given: list[str]) -> bool:
    """Whether the plant completes its states from those of the log and the given ones."""
    names = [state.name for state in logged_states(plant) if state.name in log.columns]
    like = torch.zeros(2, dtype=torch.float64)
    values = {name: like + float(np.nanmean(log.columns[name])) for name in names} | dict.fromkeys(given, like)
    drive = [
        torch.tensor([[float(np.nanmean(log.columns[signal.name])) for signal in signals]], dtype=torch.float64)
        for signals in (plant.inputs, plant.actions)
    ]
    try:
        plant.complete_states(values, *(x.reshape(1, -1) for x in drive))
    except ValueError:
        return False
    return True


def sensors_in(plant: Plant, log: SensorLog, names: Sequence[str] = ()) -> tuple[Sensor, ...]:
    """The sensors of a log, or those of the given names, with unknown noise.

    Raises:
        ValueError: if a name is nothing that can be measured, the log has no such column, or it has no sensor at all.
    """
    found = sensors_of(plant, names or [name for name in known_sensors(plant) if name in log.columns])
    absent = [sensor.name for sensor in found if sensor.name not in log.columns]
    if absent:
        raise ValueError(f"sensors={tuple(names)}: the log has no column {', '.join(absent)}; name it by --columns.")
    return found


def filled(log: SensorLog, plant: Plant, guesses: Mapping[str, float] | None = None) -> SensorLog:
    """The log with a value everywhere, so that it can be resampled; its states serve as first guesses alone.

    Missing samples are interpolated. A state that is hidden has its guess, or else the mean of the initial states that
    the plant draws.

    Raises:
        ValueError: if a guess is of a state that is not hidden, or is not finite, or a column is empty.
    """
    hidden, guesses = hidden_states(plant, log), dict(guesses or {})
    for name, value in guesses.items():
        if name not in hidden or not np.isfinite(value):
            raise ValueError(
                f"guess {name}={value}: it must be a finite value of a state without a sensor, "
                f"{', '.join(hidden) or 'of which there is none'}."
            )
    columns = {}
    for name, values in log.columns.items():
        seen = np.isfinite(values)
        if not seen.any():
            raise ValueError(f"column {name!r} of the log holds no number; leave it out.")
        columns[name] = values if seen.all() else np.interp(log.times, log.times[seen], values[seen])
    if hidden:
        usual = dict(zip((state.name for state in plant.states), usual_initial_state(plant).tolist(), strict=True))
        columns |= {name: np.full(len(log.times), guesses.get(name, usual[name])) for name in hidden}
    return replace(log, columns=columns)


def initial_spread(plant: Plant, log: SensorLog) -> Float[Tensor, " n_s"]:
    """Spread of the initial states of a log's segments: zero for those that the plant completes, infinite for others.

    Initial values of states that are logged or hidden are unknown; those that follow from others are not.
    """
    unknown = {*hidden_states(plant, log), *(state.name for state in logged_states(plant) if state.name in log.columns)}
    return torch.tensor([float("inf") if s.name in unknown else 0.0 for s in plant.states], dtype=torch.float64)


def logged_readings(
    log: SensorLog, plant: Plant, sensors: tuple[Sensor, ...], segment: Trajectory, gap: float
) -> SensorRecord:
    """What sensors read along a segment of a resampled log.

    There is a sample at the control instant nearest to each row that the sensor has, and nowhere else: what is
    interpolated between rows is no measurement. The time from the row to that instant is interpolated, between the two
    rows around it; the sample is missing if these are further apart than ``gap`` [s], or rows were left out between
    them.

    Args:
        log: the log, with NaN where a sensor lacks a sample.
        plant: plant that gives the control interval.
        sensors: sensors whose names are columns of the log.
        segment: a segment that :func:`resample` makes of the :func:`filled` log; its first state is the guess.
        gap: longest time between two rows that is bridged [s].
    """
    grid = float(segment.start) + plant.dt * np.arange(len(segment.states))
    rows = _around(log, grid)
    values = [_samples(one.measurement, log.times[rows], log.columns[one.name][rows], grid, gap) for one in sensors]
    readings = torch.from_numpy(np.stack(values, -1))
    return SensorRecord(readings, segment.actions, segment.exogenous, segment.states[0], float(segment.start))


def _around(log: SensorLog, grid: Float[np.ndarray, " samples"]) -> slice:
    """The rows between the cuts of the log around a segment."""
    cuts = np.array((0, *log.cuts, len(log.times)))
    middle = np.searchsorted(log.times, 0.5 * (grid[0] + grid[-1]), side="right") - 1
    part = int(np.searchsorted(cuts, middle, side="right"))
    return slice(int(cuts[part - 1]), int(cuts[part]))


def _samples(
    signal: Signal,
    times: Float[np.ndarray, " rows"],
    values: Float[np.ndarray, " rows"],
    grid: Float[np.ndarray, " samples"],
    gap: float,
) -> Float[np.ndarray, " samples"]:
    seen = np.isfinite(values)
    times, values = times[seen], values[seen]
    if len(times) < 2:
        return np.full(len(grid), np.nan)
    if signal.periodic:
        values = np.unwrap(values, period=signal.period)
    found = np.interp(grid, times, values, left=np.nan, right=np.nan)
    slack = ROUNDING * np.median(np.diff(grid))
    after = np.clip(np.searchsorted(times, grid - slack), 1, len(times) - 1)
    apart = times[after] - times[after - 1]
    # A row at the instant itself needs no neighbour.
    exact = np.minimum(np.abs(times[after] - grid), np.abs(times[after - 1] - grid)) <= slack
    found = np.where(exact, np.interp(grid, times, values), found)
    nearest = np.rint((times - grid[0]) * (len(grid) - 1) / (grid[-1] - grid[0]))
    measured = np.isin(np.arange(len(grid)), nearest) & (exact | (apart <= gap * (1.0 + ROUNDING)))
    return np.asarray(signal.wrapped(np.where(measured, found, np.nan)))
