"""Wind at the hub over time, and readers of TurbSim's files: hub-height text (``.hh``) and full fields (``.bts``)."""

import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from rt_torchrl.options import array_of

PRINTED_TIME_RESOLUTION = 1e-3
"""Resolution of the times in a ``.hh`` file [s]; TurbSim prints them as F8.3."""
GREATEST_SPEED = 200.0
"""Speed above which a record cannot be of wind [m/s]; tornadoes, the strongest winds on Earth, reach about 140 m/s."""
COLUMNS = "Time HorSpd WndDir VerSpd HorShr VerShr LnVShr GstSpd"


@dataclass(frozen=True, eq=False)
class WindRecord:
    """Longitudinal wind at the hub at evenly spaced times; the arrays are copied and made read-only.

    Args:
        time: sample times [s], a vector of n, which increase by equal steps to within the 1 ms that TurbSim prints.
        speed: longitudinal wind speed u [m/s], a vector of n, from 0 to ``GREATEST_SPEED``.
        source: origin of the record, such as the path of the file; every error names it.

    Raises:
        ValueError: if there are fewer than two samples, the lengths differ, a value is NaN or infinite, a time does not
            increase, samples are missing, steps are unequal, or a speed is out of its range.
    """

    time: np.ndarray
    speed: np.ndarray
    source: str

    def __post_init__(self) -> None:
        for field in ("time", "speed"):
            array = array_of(f"{self.source}: {field}", getattr(self, field))
            array.setflags(write=False)
            object.__setattr__(self, field, array)
        if fault := self._fault():
            raise ValueError(f"{self.source}: {fault}")

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def step(self) -> float:
        """Mean sampling interval [s], which averages out the rounding of printed times."""
        return self.duration / (len(self.time) - 1)

    def _fault(self) -> str:
        """What is wrong with the record and what to do; empty if nothing is."""
        time, speed = self.time, self.speed
        if time.ndim != 1 or time.shape != speed.shape:
            return f"time has shape {time.shape} and speed {speed.shape}; pass two vectors of equal length."
        if len(time) < 2:
            return f"holds {len(time)} wind samples; at least 2 are needed: is the file written to its end?"
        steps = np.diff(time)
        # Two times rounded to 1 ms give a step that is off by up to 1 ms; below 2 ms this would hide a missing sample.
        step = float(np.median(steps))
        uneven = ~(np.abs(steps - step) <= min(1.01 * PRINTED_TIME_RESOLUTION, 0.5 * step))
        faults = {
            "wind speed at t = {0:g} s is {2:g} m/s; it must be from 0 to 200 m/s. Check its unit, its sign and the "
            "direction, 0 deg along the rotor axis, or fill the gap.": ~((speed >= 0.0) & (speed <= GREATEST_SPEED)),
            "time goes from {0:g} s to {1:g} s; it must increase. Sort the samples, drop doubles.": ~(steps > 0.0),
            "the step after t = {0:g} s is {3:g} s instead of {4:g} s. Fill the gap by interpolation, cut the record "
            "there, or resample it to equal steps.": uneven,
        }
        for text, wrong in faults.items():
            if wrong.any():
                k = int(np.argmax(wrong))
                after = min(k + 1, len(steps))
                return text.format(time[k], time[after], speed[k], time[after] - time[k], step)
        return ""


def read_wind(path: str | os.PathLike[str]) -> WindRecord:
    """Wind at the hub from a TurbSim file of either kind; the suffix tells the kind.

    Args:
        path: path of a ``.hh`` file, see :func:`read_hh`, or of a ``.bts`` file, see :func:`read_bts`.

    Raises:
        ValueError: if the suffix is another one, or the file is malformed.
        OSError: if the file cannot be read.
    """
    readers = {".hh": read_hh, ".bts": read_bts}
    suffix = Path(path).suffix.lower()
    if suffix not in readers:
        raise ValueError(
            f"{path}: suffix {suffix!r} is no wind format read here; pass TurbSim output, hub-height text '.hh' "
            "(WrADHH; under another name by read_hh) or binary full field '.bts' (WrADFF)."
        )
    return readers[suffix](path)


def read_hh(path: str | os.PathLike[str]) -> WindRecord:
    r"""Longitudinal wind at the hub from hub-height text, TurbSim's ``.hh`` (``WrADHH``).

    A comment begins with ``!``, ``#`` or ``%``; every other line holds Time [s], HorSpd [m/s], WndDir [deg], VerSpd
    [m/s], HorShr [-], VerShr [-], LnVShr [-], GstSpd [m/s] and, in later versions of the format, Upflow [deg]. At the
    hub the shears vanish, and the component along the rotor axis is

    .. math:: u = (V_{hor} + V_{gust}) \cos\delta

    The horizontal speed alone contains the lateral turbulence and exceeds u by 1 % at 16 % turbulence. With the
    direction, u agrees with the ``.bts`` file of the same run.

    Raises:
        ValueError: if a line has too few columns or a value that is no finite number; the message names the line.
            Otherwise as in :class:`WindRecord`.

    Source: Jonkman, *TurbSim User's Guide*, NREL/TP-500-46198; OpenFAST InflowWind, uniform wind.
    """
    rows = []
    with open(path, encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, start=1):
            # Fortran's list-directed input separates by blanks or commas.
            fields, where = re.split("[!#%]", line)[0].replace(",", " ").split(), f"{path}, line {number}"
            if not fields:
                continue
            if len(fields) < 8:
                raise ValueError(f"{where}: {len(fields)} columns, but 8 are needed: {COLUMNS}. Complete the line.")
            try:
                rows.append([float(field) for field in fields[:8]])
            except ValueError as error:
                raise ValueError(f"{where}: {error}; begin the line with '!' if it is a comment.") from None
            if not np.isfinite(rows[-1]).all():
                raise ValueError(f"{where}: value 'NaN' or 'inf' in {line.strip()!r} is not finite. Fill the gap.")
    columns = np.array(rows, dtype=np.float64).reshape(-1, 8)
    speed = (columns[:, 1] + columns[:, 7]) * np.cos(np.deg2rad(columns[:, 2]))
    return WindRecord(columns[:, 0], speed, str(path))


COUNTS, SCALES = ("n_z", "n_y", "n_tower", "n_t"), ("dz", "dy", "dt", "mean_speed", "hub_height", "bottom")
UNITS = ("u_slope", "u_offset", "v_slope", "v_offset", "w_slope", "w_offset")
HEADER = np.dtype(
    [("identifier", "<i2"), *((name, "<i4") for name in COUNTS), *((name, "<f4") for name in (*SCALES, *UNITS))]
    + [("n_description", "<i4")]
)
"""The fixed part of a ``.bts`` file, in the order in which it is written."""
AGAIN = "Copy the file again, in binary mode, or run TurbSim with WrADFF again."


def read_bts(path: str | os.PathLike[str]) -> WindRecord:
    r"""Longitudinal wind at the hub from a binary full field, TurbSim's ``.bts`` (``WrADFF``).

    The file is little endian. It holds a header, a description, and 16-bit integers for every time step: those of the
    grid, with the components u, v, w fastest, y next and z slowest, then those of the tower. A velocity is
    :math:`v = (\mathrm{raw} - \mathrm{offset})/\mathrm{slope}`. The hub is at the middle of the grid's width and need
    not be a grid point: u is interpolated bilinearly between the four points around it.

    Raises:
        ValueError: if the file is not of this format, its length is not the one that its header implies, or the hub
            lies outside the grid; otherwise as in :class:`WindRecord`.

    Source: Jonkman, *TurbSim User's Guide*, NREL/TP-500-46198, appendix on binary full-field files.
    """
    size = os.path.getsize(path)
    if size < HEADER.itemsize:
        raise ValueError(f"{path}: holds {size} bytes, but the header alone takes {HEADER.itemsize} bytes. {AGAIN}")
    record = np.fromfile(path, HEADER, 1)[0]
    header = SimpleNamespace(**{name: record[name].item() for name in record.dtype.names})
    counts_right = min(header.n_z, header.n_y, header.n_t) >= 1 and min(header.n_tower, header.n_description) >= 0
    scales_right = min(header.dz, header.dy, header.dt, header.u_slope) > 0
    finite = all(math.isfinite(value) for value in vars(header).values())
    if not (header.identifier in (7, 8) and counts_right and scales_right and finite):
        raise ValueError(
            f"{path}: is no TurbSim full field, or is corrupt: its header is {header}, but the identifier must be 7 or "
            f"8, counts and spacings positive, all values finite. {AGAIN}"
        )
    start = HEADER.itemsize + header.n_description
    shape = (header.n_t, header.n_z * header.n_y + header.n_tower, 3)
    expected = start + 2 * math.prod(shape)
    if size != expected:
        raise ValueError(f"{path}: holds {size} bytes, but its header implies {expected} bytes: {header}. {AGAIN}")
    # The field is mapped and not read, because it has hundreds of megabytes, of which the hub needs four columns. The
    # reader of openfast_toolbox and weio allocates what the header declares, in double precision, and checks no length.
    raw = np.memmap(path, dtype="<i2", mode="r", offset=start, shape=shape)
    z = _interpolation(path, (header.hub_height - header.bottom) / header.dz, header.n_z, "height")
    y = _interpolation(path, 0.5 * (header.n_y - 1), header.n_y, "width")
    corners = [a * b * raw[:, i * header.n_y + j, 0].astype(np.float64) for i, a in z for j, b in y]
    # The interval is stored in single precision; its shortest decimal is the number that TurbSim was given.
    time = float(str(np.float32(header.dt))) * np.arange(header.n_t)
    return WindRecord(time, (np.sum(corners, axis=0) - header.u_offset) / header.u_slope, str(path))


def _interpolation(path: str | os.PathLike[str], position: float, n: int, side: str) -> list[tuple[int, float]]:
    """Grid points around a position in grid spacings, with their linear weights."""
    # A hub on the grid's edge may be off by the single precision of the heights.
    if not -1e-3 <= position <= n - 1 + 1e-3:
        raise ValueError(
            f"{path}: the hub lies outside the {side} of the grid, {position:g} spacings from its first point, which "
            f"has {n} points; run TurbSim with a grid around the hub."
        )
    position = min(max(position, 0.0), n - 1.0)
    below = min(int(position), max(n - 2, 0))
    weight = position - below
    return [(below, 1.0 - weight), (below + 1, weight)] if weight > 0 else [(below, 1.0)]
