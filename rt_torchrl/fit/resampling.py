r"""A log with irregular instants at a plant's control intervals: segments, and what its sensors read along them.

A plant is a sampled-data system. Its states are instantaneous, so they are interpolated linearly at :math:`t_k`. Its
actions and exogenous inputs are held over an interval, so the value over :math:`[t_k, t_{k+1}]` is the mean of the
log's held values over that interval. The mean keeps the impulse of a force and the energy of a load, however irregular
the instants are. A periodic state is interpolated the short way round: between two rows it turns by less than half a
turn.

What is interpolated drives the twin and guesses its first states; it is no measurement. Samples are where the log has
rows, and states may have no sensor at all.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from rt_torchrl.fit.log import TIME, Rows, SensorLog, logged_states
from rt_torchrl.fit.sensors import Sensor, SensorRecord, known_sensors, sensors_of
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal
from rt_torchrl.trajectories.trajectory import Trajectory

Samples = Float[np.ndarray, " samples"]
"""Values at control instants, or these instants."""
GAP_INTERVALS = 3.0
"""Number of sampling intervals after which a pause counts as a gap, unless a limit is given."""
INTERVALS_PER_ROW = 50
"""Greatest number of control intervals for each row of a log; with more, its time probably has another unit."""
DRAWS = 100
"""Number of initial states of a plant whose mean is the guess of a hidden one."""
ROUNDING = 1e-6
"""Share of an interval by which an instant may miss the grid, beside the rounding of the instant itself."""


class Resampled(NamedTuple):
    """Segments of a log, in order, and the parts that were left out; times are in s."""

    segments: list[Trajectory]
    interval: float  # median sampling interval
    jitter: float  # standard deviation of the intervals within the segments, over their median
    gap: float  # longest time between two rows that was bridged
    gaps: list[tuple[float, float]]  # last time before and first time after each gap
    too_short: list[tuple[float, float]]  # first and last time of each part that was left out


def resample(log: SensorLog, plant: Plant, *, gap: float | None = None, shortest: int = 10) -> Resampled:
    """Cut a log at its gaps and where rows were left out, and bring each part to the plant's control intervals.

    Args:
        log: log that :func:`rt_torchrl.fit.log.checked` has returned.
        plant: plant that gives the control interval dt and :meth:`Plant.complete_states`.
        gap: longest time between two rows that is bridged [s]; None for three median sampling intervals, but not less
            than dt.
        shortest: number of control intervals below which a part is left out.

    Raises:
        ValueError: if no part is long enough, there are far more control intervals than rows, or a state is missing
            that the plant cannot complete.
    """
    intervals, left_out = np.diff(log.times), np.array(log.cuts, dtype=int) - 1
    sampled = np.delete(intervals, left_out)
    interval = float(np.median(sampled if len(sampled) else intervals))
    limit = max(GAP_INTERVALS * interval, plant.dt) if gap is None else gap
    cuts = np.union1d(np.flatnonzero(intervals > limit * (1.0 + ROUNDING)), left_out)
    ends = np.stack([np.append(0, cuts + 1), np.append(cuts, len(intervals))], -1)
    slack = _slack(log.times, plant.dt)
    parts = [(k, last, int((log.times[last] - log.times[k] + slack) / plant.dt)) for k, last in ends]
    too_short = [(float(log.times[first]), float(log.times[last])) for first, last, steps in parts if steps < shortest]
    enough = [part for part in parts if part[2] >= shortest]
    rows, steps = len(log.times), sum(steps for *_, steps in enough)
    if steps > INTERVALS_PER_ROW * rows:  # before it takes memory
        raise ValueError(
            f"column 'time' of the log has a median step of {interval:g} s, so that {rows} rows would become {steps} "
            f"control intervals of plant {plant.name!r} (dt={plant.dt:g} s). Say the unit of the column if it is not "
            "seconds, such as --columns ms=time*1e-3, or give the twin a longer dt."
        )
    segments = [_segment(log, slice(first, last + 1), steps, plant) for first, last, steps in enough]
    if not segments:
        raise ValueError(
            f"log of {rows} rows has no part of {shortest} control intervals of {plant.dt:g} s without a gap "
            f"longer than {limit:g} s or a row that was left out ({len(left_out)} such places); raise --gap above "
            f"{interval:g} s, its median sampling interval, or log longer."
        )
    within = np.delete(intervals, cuts)
    gaps = [(float(log.times[k]), float(log.times[k + 1])) for k in cuts]
    return Resampled(segments, interval, float(within.std() / interval), float(limit), gaps, too_short)


def hold_out(
    segments: Sequence[Trajectory], dt: float, share: float, *, shortest: int = 10
) -> tuple[list[Trajectory], list[Trajectory]]:
    """Split segments into those to train on and later ones to judge by; the segment at the cut is divided.

    Args:
        segments: segments of the log, in order.
        dt: control interval [s].
        share: share of all control intervals that is held out to judge by, between 0 and 1.
        shortest: number of control intervals that a part of the divided segment needs; a segment with a shorter part
            stays whole.

    Raises:
        ValueError: if one side is left empty.
    """
    total = sum(len(segment.actions) for segment in segments)
    train_count = total - round(share * total)  # intervals to train on
    training, held_out, passed = [], [], 0
    for segment in segments:
        n = len(segment.actions)
        cut = min(max(train_count - passed, 0), n)
        cut = 0 if cut < shortest else n if n - cut < shortest else cut
        if cut:
            training.append(segment.part(0, cut, dt))
        if cut < n:
            held_out.append(segment.part(cut, n, dt))
        passed += n
    if not (training and held_out):
        raise ValueError(
            f"held_out={share} of {total} control intervals leaves no {shortest} of them to "
            f"{'train on' if not training else 'judge by'}; choose another share, or log longer."
        )
    return training, held_out


def hold_means(times: Rows, values: Rows, grid: Samples) -> Float[np.ndarray, " intervals"]:
    """Exact means, over every interval of a grid, of a signal that holds its value from each time to the next.

    It holds its last value on.
    """
    times = np.append(times, max(times[-1], grid[-1]) + 1.0)
    integral = np.append(0.0, np.cumsum(values * np.diff(times)))
    return np.diff(np.interp(grid, times, integral)) / np.diff(grid)


def _held(log: SensorLog, rows: slice, signals: Sequence[Signal], grid: Samples) -> Float[Tensor, "intervals signals"]:
    values = np.empty((len(grid) - 1, len(signals)))  # a plant may have no inputs
    for k, signal in enumerate(signals):
        values[:, k] = hold_means(log.times[rows], log.columns[signal.name][rows], grid)
    return torch.from_numpy(values)


def _segment(log: SensorLog, rows: slice, steps: int, plant: Plant) -> Trajectory:
    times = log.times[rows]
    grid = times[0] + plant.dt * np.arange(steps + 1)
    actions = _held(log, rows, plant.actions, grid)
    exogenous = plant.with_previews(_held(log, rows, plant.acting_inputs, grid)[None])[0]
    measured = {TIME: torch.from_numpy(grid)}
    for state in logged_states(plant):
        if state.name in log.columns:
            values = _unwrapped(state, log.columns[state.name][rows])
            measured[state.name] = torch.from_numpy(state.wrapped(np.interp(grid, times, values)))
    states = plant.complete_states(measured, exogenous, actions)
    seen = torch.zeros(steps + 1, dtype=torch.bool)
    nearest = np.rint((times - times[0]) / plant.dt).astype(int)
    seen[torch.from_numpy(nearest[nearest <= steps])] = True
    return Trajectory(states, actions, exogenous, float(times[0]), None if seen.all() else seen)


def _slack(times: Rows, dt: float) -> float:
    """Time by which an instant may miss the grid; the seconds of Unix are rounded to a quarter of a microsecond."""
    return ROUNDING * dt + 2.0 * float(np.spacing(np.abs(times).max()))


def _unwrapped(signal: Signal, values: Rows) -> Rows:
    """The values without jumps by a turn; they go the short way round from row to row."""
    return np.unwrap(values, period=signal.period) if signal.periodic else values


def hidden_states(plant: Plant, log: SensorLog) -> list[str]:
    """States that a log does not hold, and that the plant cannot complete from those that it holds."""
    logged = [state.name for state in logged_states(plant) if state.name in log.columns]
    lacking = [state.name for state in logged_states(plant) if state.name not in log.columns]
    like = torch.zeros(2, dtype=torch.float64)
    measured = {name: like + float(np.nanmean(log.columns[name])) for name in logged}
    inputs, actions = (
        torch.tensor([[float(np.nanmean(log.columns[signal.name])) for signal in signals]], dtype=torch.float64)
        for signals in (plant.acting_inputs, plant.actions)
    )

    def completes(name: str) -> bool:
        others = {other: like for other in lacking if other != name}
        try:
            plant.complete_states(measured | others, plant.with_previews(inputs[None])[0], actions)
        except ValueError:
            return False
        return True

    return [name for name in lacking if not completes(name)]


def sensors_in(
    plant: Plant, log: SensorLog, names: Sequence[str] = (), biased: Sequence[str] = ()
) -> tuple[Sensor, ...]:
    """The sensors of a log, or those of the given names; see :func:`rt_torchrl.fit.sensors.sensors_of`.

    Raises:
        ValueError: as :func:`~rt_torchrl.fit.sensors.sensors_of`, or if the log has no such column.
    """
    sensors = sensors_of(plant, names or [name for name in known_sensors(plant) if name in log.columns], biased)
    absent = [sensor.name for sensor in sensors if sensor.name not in log.columns]
    if absent:
        raise ValueError(f"sensors={tuple(names)}: the log has no column {', '.join(absent)}; name it by --columns.")
    return sensors


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
        finite = np.isfinite(values)
        if not finite.any():
            raise ValueError(f"column {name!r} of the log holds no number; leave it out.")
        columns[name] = values if finite.all() else np.interp(log.times, log.times[finite], values[finite])
    if hidden:
        drawn = plant.draw_initial_state(DRAWS, torch.Generator().manual_seed(0)).mean(0)
        usual = dict(zip((state.name for state in plant.states), drawn.tolist(), strict=True))
        columns |= {name: np.full(len(log.times), guesses.get(name, usual[name])) for name in hidden}
    return replace(log, columns=columns)


def initial_spread(plant: Plant, log: SensorLog) -> Float[Tensor, " n_s"]:
    """Spread of the initial states of a log's segments: zero for those that the controller computes, else infinite.

    A log need not begin where states that no sensor reads are at rest.
    """
    unread = plant.states[len(plant.readings) :]
    unknown = {*hidden_states(plant, log), *(state.name for state in logged_states(plant) if state.name in log.columns)}
    unknown |= {state.name for state in unread if state.name not in plant.controller_states}
    return torch.tensor([float("inf") if s.name in unknown else 0.0 for s in plant.states], dtype=torch.float64)


def logged_readings(
    log: SensorLog, plant: Plant, sensors: tuple[Sensor, ...], segment: Trajectory, gap: float
) -> SensorRecord:
    """What sensors read along a segment of a resampled log.

    There is a sample at the control instant nearest to each row that the sensor has, and nowhere else: what is
    interpolated between rows is no measurement. The time from the row to that instant is interpolated, between the two
    rows around it; the sample is missing if these are further apart than ``gap`` [s], or rows were left out between
    them. In the last sample sensors read the inputs that the log holds from there on; previews of these are not known.

    Args:
        log: the log, with NaN where a sensor lacks a sample.
        plant: plant that gives the control interval.
        sensors: sensors whose names are columns of the log.
        segment: a segment that :func:`resample` makes of the :func:`filled` log; its first state is the guess.
        gap: longest time between two rows that is bridged [s].
    """
    grid = float(segment.start) + plant.dt * np.arange(len(segment.states))
    rows = _around(log, grid)
    values = [_samples(s.measurement, log.times[rows], log.columns[s.name][rows], grid, gap) for s in sensors]
    readings = torch.from_numpy(np.stack(values, -1))
    inputs = _held(log, rows, plant.acting_inputs, grid[-1] + plant.dt * np.arange(2))
    exogenous = torch.cat([segment.exogenous, pad(inputs, (0, len(plant.previews)), value=torch.nan)])
    states = segment.states
    return SensorRecord(readings, segment.actions, exogenous, states[0], float(segment.start), course=states)


def _around(log: SensorLog, grid: Samples) -> slice:
    """The rows between the cuts of the log around a segment."""
    cuts = np.array((0, *log.cuts, len(log.times)))
    middle = np.searchsorted(log.times, 0.5 * (grid[0] + grid[-1]), side="right") - 1
    part = int(np.searchsorted(cuts, middle, side="right"))
    return slice(int(cuts[part - 1]), int(cuts[part]))


def _samples(signal: Signal, times: Rows, values: Rows, grid: Samples, gap: float) -> Samples:
    finite = np.isfinite(values)
    times, values = times[finite], values[finite]
    if len(times) < 2:
        return np.full(len(grid), np.nan)
    values = _unwrapped(signal, values)
    interpolated = np.interp(grid, times, values, left=np.nan, right=np.nan)
    slack = _slack(grid, np.median(np.diff(grid)))
    after = np.clip(np.searchsorted(times, grid - slack), 1, len(times) - 1)
    spacing = times[after] - times[after - 1]
    # A row at the instant itself needs no neighbour.
    exact = np.minimum(np.abs(times[after] - grid), np.abs(times[after - 1] - grid)) <= slack
    interpolated = np.where(exact, np.interp(grid, times, values), interpolated)
    nearest = np.rint((times - grid[0]) * (len(grid) - 1) / (grid[-1] - grid[0]))
    measured = np.isin(np.arange(len(grid)), nearest) & (exact | (spacing <= gap * (1.0 + ROUNDING)))
    return np.asarray(signal.wrapped(np.where(measured, interpolated, np.nan)))
