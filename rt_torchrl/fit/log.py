"""Recorded logs of a real system's sensors and actuators, in CSV or Parquet files."""

import csv
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rt_torchrl.fit.sensors import known_sensors
from rt_torchrl.loading import of_extra
from rt_torchrl.options import OTHER_UNITS, Positive, configuration
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

TIME = "time"
NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
COLUMN = re.compile(
    rf"(?P<header>.+)=(?P<signal>\w+)(?:\[(?P<unit>[^][=]+)\]|(?:\*(?P<factor>[+-]?{NUMBER}))?(?P<offset>[+-]{NUMBER})?)",
    re.DOTALL,
)
WITH_OFFSET = r"\d[Tt ].*(?:[Zz]|[+-]\d{2}(?::?\d{2})?)$"
"""A date whose time of day says by how much it is ahead of UTC."""


Rows = Float[np.ndarray, " rows"]
"""Values of a column."""


@configuration
class LogConfig:
    """How a log is read.

    Args:
        columns: columns of the log with another name than their signal or another unit, as HEADER=SIGNAL[UNIT] or
            HEADER=SIGNAL*FACTOR+OFFSET.
        drop: whether to leave out rows of the log with a value that is missing or out of range; they become gaps.
        gap: longest time between two rows of the log that is bridged [s]; by default three sampling intervals.
    """

    columns: tuple[str, ...] = ()
    drop: bool = False
    gap: Positive | None = None


class Column(NamedTuple):
    r"""A column of a file, the signal that it holds, and its unit: a name, or value = factor·number + offset.

    Args:
        header: header of the column in the file.
        signal: name of the plant's signal, or ``time``.
        factor: factor from the column's numbers to the signal's unit.
        offset: value of the signal where the column holds zero, in the signal's unit.
        unit: unit of the column's numbers, such as ``rpm``, ``kPa``, ``°F`` or ``%``: that of the signal, or one of
            ``OTHER_UNITS`` for it; None if they have the unit of the signal, or if factor and offset convert them.
    """

    header: str
    signal: str
    factor: float = 1.0
    offset: float = 0.0
    unit: str | None = None

    @classmethod
    def parse(cls, text: str) -> "Column":
        """The column that ``HEADER=SIGNAL``, ``HEADER=SIGNAL[UNIT]`` or ``HEADER=SIGNAL*FACTOR+OFFSET`` describes.

        Raises:
            ValueError: if the text has another form, or the factor is zero.
        """
        match = COLUMN.fullmatch(text.strip())
        if match is None or not (factor := float(match["factor"] or 1.0)):
            raise ValueError(
                f"column {text!r} is not understood; write HEADER=SIGNAL, HEADER=SIGNAL[UNIT] or "
                "HEADER=SIGNAL*FACTOR+OFFSET, such as n=rotor_speed[rpm] or T=wall_temperature*0.5556+255.37."
            )
        return cls(match["header"], match["signal"], factor, float(match["offset"] or 0.0), match["unit"])


@dataclass(frozen=True, kw_only=True)
class SensorLog:
    """Signals of a real system, sampled together at instants that need not be regular.

    A row holds what a controller knows and does at one instant. States are instantaneous; actions and exogenous inputs
    are held until the next row.

    Args:
        times: instants of the rows [s], increasing.
        columns: values of every signal by name, in the signal's unit; NaN where a sensor gave no value.
        cuts: numbers of the rows before which other rows were left out. What the actions did there is not known, so
            that no part of the log goes over a cut, however short the time.

    Raises:
        ValueError: if the times are not finite and increasing.
    """

    times: Rows
    columns: dict[str, Rows]
    cuts: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        t = self.times
        wrong = np.flatnonzero(~(np.diff(t, prepend=-np.inf) > 0.0) | ~np.isfinite(t))
        if len(t) < 2 or wrong.size:
            row = f"; row {wrong[0]} (counted from 0) has {t[wrong[0]]:.12g} s" if wrong.size else ""
            raise ValueError(
                f"times of the log must be at least 2, finite and increasing, and are {len(t)} with {wrong.size} that "
                f"are not{row}. Sort the log and keep one row of each instant."
            )

    def chosen(self, rows: Bool[np.ndarray, " rows"]) -> "SensorLog":
        """The log of some of its rows; rows that are left out become a gap."""
        kept = np.flatnonzero(rows)
        cuts = {*(np.flatnonzero(np.diff(kept) > 1) + 1).tolist(), *np.searchsorted(kept, self.cuts).tolist()}
        return SensorLog(
            times=self.times[rows],
            columns={name: values[rows] for name, values in self.columns.items()},
            cuts=tuple(sorted(cuts - {0, len(kept)})),
        )

    def without(self, names: Sequence[str]) -> "SensorLog":
        """The log without the columns of these names."""
        return replace(self, columns={k: v for k, v in self.columns.items() if k not in names})

    def write(self, path: Path) -> None:
        """Write the log as Parquet if the path ends in ``.parquet``, otherwise as CSV.

        :func:`read_log` reads it without a mapping of columns.
        """
        frame = pandas().DataFrame({TIME: self.times, **self.columns})
        if path.suffix.lower() == ".parquet":
            frame.to_parquet(path, index=False)
        else:
            frame.to_csv(path, index=False)


def logged_states(plant: Plant | type[Plant]) -> tuple[Signal, ...]:
    """States that have a column of their own in a log; a state with the name of an action or input has none."""
    driven = {signal.name for signal in (*plant.actions, *plant.inputs)}
    return tuple(state for state in plant.states if state.name not in driven)


def logged_signals(plant: Plant) -> tuple[Signal, ...]:
    """Signals that a log of this plant can hold: its states and measurements, actions and exogenous inputs.

    Previews of an input are computed from it, and need no column.
    """
    states = logged_states(plant)
    names = {state.name for state in states}
    others = tuple(sensor.measurement.signal for name, sensor in known_sensors(plant).items() if name not in names)
    return (*states, *plant.actions, *plant.acting_inputs, *others)


def read_log(path: Path, plant: Plant, columns: Sequence[Column] = ()) -> SensorLog:
    """Read the columns of a file that hold signals of a plant; other columns are ignored.

    Blanks around a header do not count.

    Args:
        path: file whose name ends in ``.csv`` or ``.parquet``. Its time is a number of seconds on the plant's clock,
            or a date and time of day (ISO 8601), which is counted from the first row. Either all dates have an offset
            from UTC or none has.
        plant: plant whose signals the file holds.
        columns: columns whose header is not the name of their signal, or whose unit is not that of their signal.

    Raises:
        ValueError: if the file cannot be read, a line has more entries than the header, a column is missing, is there
            twice, names an unknown signal or is not numeric, the times are not increasing, or the unit of a
            column is not known for its signal.
    """
    frame = _read(path)
    headers = list(frame)
    units = {TIME: "s"} | {signal.name: signal.unit for signal in logged_signals(plant)}
    declared = {column.signal: column for column in columns}
    if len(declared) < len(columns):
        raise ValueError(f"columns {[c.header for c in columns]} name a signal twice; give each signal one column.")
    chosen = {name: Column(name, name) for name in units if name in headers} | declared
    for column in chosen.values():
        if headers.count(column.header.strip()) != 1 or column.signal not in units:
            raise ValueError(
                f"column {column.header!r} for {column.signal!r}: {path} has the columns {', '.join(headers)}, of "
                f"which one must have this header; plant {plant.name!r} has the signals {', '.join(units)}."
            )
    if TIME not in chosen:
        raise ValueError(
            f"{path} has no column 'time'; it has {', '.join(headers)}. Say which it is, such as --columns t=time. In "
            "CSV files, commas part the columns."
        )
    values = {name: _values(frame[column.header.strip()], column, units[name], path) for name, column in chosen.items()}
    return SensorLog(times=values.pop(TIME), columns=values)


def checked(log: SensorLog, plant: Plant, *, drop: bool = False, missing: bool = False) -> SensorLog:
    """The log, once it is certain that it can drive a twin of this plant.

    Args:
        log: log as it was read.
        plant: plant that gives the signals that are needed and the range of each signal.
        drop: whether to leave out rows in which a value is missing or out of range, instead of refusing the log.
        missing: whether a sensor may lack samples; its row stays, with NaN. An action or input must have every value.

    Raises:
        ValueError: if an action or input has no column; without ``drop`` also if a value is missing or out of range.
    """
    driven = {signal.name for signal in (*plant.actions, *plant.acting_inputs)}
    absent = [signal.name for signal in (*plant.actions, *plant.acting_inputs) if signal.name not in log.columns]
    if absent:
        raise ValueError(
            f"log of plant {plant.name!r} has no column {', '.join(absent)}; it has {', '.join(log.columns)}. Every "
            f"action and input drives the twin: log it, or name its column, such as --columns HEADER={absent[0]}."
        )
    good = np.ones(len(log.times), dtype=bool)
    for signal in logged_signals(plant):
        if signal.name not in log.columns:
            continue
        values = log.columns[signal.name]
        # A sensor of a periodic state may count its turns.
        inside = np.isfinite(values) & (signal.periodic | ((values >= signal.low) & (values <= signal.high)))
        inside |= np.isnan(values) & (missing and signal.name not in driven)
        if not (drop or inside.all()):
            k = int(np.argmin(inside))
            raise ValueError(
                f"{signal.name} is {values[k]:g} {signal.unit} in row {k} of the log, one of {int((~inside).sum())}; "
                f"it must be a number from {signal.low:g} to {signal.high:g} {signal.unit}. Mend the log or its "
                "units, leave out rows with --drop (of a training: --log.drop), or keep missing samples with --missing."
            )
        good &= inside
    return log if good.all() else log.chosen(good)


def _read(path: Path) -> Any:
    """The table of a file, with its headers."""
    if (kind := path.suffix.lower()) not in READERS:
        raise ValueError(f"log {path} ends in {path.suffix!r}; it must be one of {', '.join(READERS)}.")
    try:
        frame = READERS[kind](path)
    except Exception as error:  # the readers of tables raise errors of many kinds at what is wrong in a file
        raise ValueError(f"log {path} cannot be read: {type(error).__name__}: {error}") from error
    frame.columns = [str(header).strip() for header in frame]
    return frame


def _read_csv(path: Path) -> Any:
    """The table with the columns as the header says; pandas renames a header that is there twice."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        headers = next((row for row in csv.reader(file) if row), [])
    with warnings.catch_warnings():
        warnings.simplefilter("error", pandas().errors.ParserWarning)  # of lines that are longer than the header
        frame = pandas().read_csv(path, index_col=False)
    frame.columns = [header.strip() or name for header, name in zip(headers, frame, strict=True)]
    return frame


def _read_parquet(path: Path) -> Any:
    frame = pandas().read_parquet(path)
    # An index with a name is a column of the file.
    return frame.reset_index() if any(name is not None for name in frame.index.names) else frame


READERS: dict[str, Callable[[Path], Any]] = {".csv": _read_csv, ".parquet": _read_parquet}
"""What reads a file, by the end of its name in small letters."""


def _values(series: Any, column: Column, unit: str, path: Path) -> Rows:
    """Numbers of a column in the signal's unit; a date becomes the seconds since the first date."""
    pd, about, text = pandas(), f"column {column.header!r} of {path}", series.astype(str)
    numbers = pd.to_numeric(series if pd.api.types.is_numeric_dtype(series) else text, errors="coerce")
    present = series.notna() & ~text.str.strip().str.lower().isin(("", "nan"))
    wrong = numbers.isna() & present
    if column.signal == TIME and column.unit is None and wrong.any() and wrong[present].all():
        return _seconds(text, present, about)
    if wrong.any():
        raise ValueError(f"{about} holds an entry that is {_entry(text, wrong, 'a number')}")
    known = {unit: (1.0, 0.0)} | {name: (size, zero) for name, size, zero in OTHER_UNITS.get(unit, ())}
    if column.unit not in (None, *known):
        raise ValueError(
            f"{about} for signal {column.signal!r}: unit {column.unit!r} is none of {', '.join(known)}; convert from "
            "others by HEADER=SIGNAL*FACTOR+OFFSET."
        )
    factor, offset = (column.factor, column.offset) if column.unit is None else known[column.unit]
    values: Rows = factor * numbers.to_numpy(dtype=np.float64, na_value=np.nan) + offset
    return values


def _seconds(text: Any, present: Any, about: str) -> Rows:
    """The seconds of dates since the first one."""
    dates = pandas().to_datetime(text, utc=True, format="ISO8601", errors="coerce")
    offset = text.str.contains(WITH_OFFSET)
    faults = {
        "a date (ISO 8601)": dates.isna(),
        "like the first one: with an offset from UTC, or without": offset != offset[present].iloc[0],
    }
    for what, wrong in faults.items():
        if (wrong & present).any():
            raise ValueError(f"{about} holds an entry that is {_entry(text, wrong & present, what)}")
    seconds: Rows = (dates - dates.dropna().iloc[0]).dt.total_seconds().to_numpy()
    return seconds


def _entry(text: Any, wrong: Any, what: str) -> str:
    """The first entry that is not what it should be, for a message."""
    k = int(np.argmax(wrong.to_numpy()))
    return f"not {what}: {text.iloc[k]!r} in row {k} (counted from 0), {int(wrong.sum())} such rows."


def pandas() -> Any:
    """The library pandas, which reads and writes tables; only logs need it.

    Raises:
        ValueError: if it is not installed.
    """
    return of_extra("pandas", "logs")
