"""Readers of TurbSim's wind files: hub-height text (``.hh``) and binary full field (``.bts``)."""

import math
import os
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rt_torchrl.envs.wind_turbine.wind_record import WindRecord


def read_wind(path: str | os.PathLike[str]) -> WindRecord:
    """Wind at the hub from a TurbSim file of either kind; the suffix tells the kind.

    Args:
        path: path of a ``.hh`` file, see :func:`read_hh`, or of a ``.bts`` file, see :func:`read_bts`.

    Raises:
        ValueError: if the suffix is another one, or the file does not exist or is malformed.
    """
    readers = {".hh": read_hh, ".bts": read_bts}
    suffix = Path(path).suffix.lower()
    if suffix not in readers:
        raise ValueError(
            f"{path}: suffix {suffix!r} is no wind format read here; pass TurbSim output, hub-height text '.hh' "
            "(WrADHH) or binary full field '.bts' (WrADFF). A file in the .hh format under another name can go to "
            "read_hh."
        )
    if not Path(path).is_file():
        raise ValueError(f"{path} is no file; give the path of TurbSim output.")
    return readers[suffix](path)


def read_hh(path: str | os.PathLike[str]) -> WindRecord:
    r"""Longitudinal wind at the hub from hub-height text, TurbSim's ``.hh`` (``WrADHH``).

    Comment lines hold ``!``, ``#`` or ``%``; every other line holds Time [s], HorSpd [m/s], WndDir [deg], VerSpd
    [m/s], HorShr [-], VerShr [-], LnVShr [-], GstSpd [m/s] and, in later versions of the format, Upflow [deg]. At the
    hub the shears vanish, and the component along the rotor axis is

    .. math:: u = (V_{hor} + V_{gust}) \cos\delta

    The horizontal speed alone contains the lateral turbulence and exceeds u by 1 % at 16 % turbulence. With the
    direction, u agrees with the ``.bts`` file of the same run.

    Args:
        path: path of the file.

    Raises:
        ValueError: if a line has too few columns or a value that is no finite number; the message names the line.
            Otherwise as in :class:`WindRecord`.

    Source: Jonkman, *TurbSim User's Guide*, NREL/TP-500-46198; OpenFAST InflowWind, uniform wind.
    """
    rows = []
    with open(path, encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, start=1):
            if line.strip() and not any(mark in line for mark in "!#%"):
                rows.append(_parse_hh_line(line, f"{path}, line {number}"))
    columns = np.array(rows, dtype=np.float64).reshape(-1, 8)
    speed = (columns[:, 1] + columns[:, 7]) * np.cos(np.deg2rad(columns[:, 2]))
    return WindRecord(columns[:, 0], speed, str(path))


def _parse_hh_line(line: str, where: str) -> list[float]:
    # Fortran's list-directed input separates by blanks or commas.
    fields = line.replace(",", " ").split()
    if len(fields) < 8:
        raise ValueError(
            f"{where}: {len(fields)} columns, but 8 are needed: Time HorSpd WndDir VerSpd HorShr VerShr LnVShr GstSpd. "
            "Complete the line, or begin it with '!' if it is a comment."
        )
    try:
        values = [float(field) for field in fields[:8]]
    except ValueError as error:
        raise ValueError(
            f"{where}: {error}; 8 numbers are needed. Correct the line, or begin it with '!' if it is a comment."
        ) from None
    for field, value in zip(fields, values, strict=False):
        if not math.isfinite(value):
            raise ValueError(
                f"{where}: value {field!r} is not finite. Fill the gap by interpolation or cut the record there."
            )
    return values


class _FieldHeader(NamedTuple):
    """The fixed part of a ``.bts`` file, in the order in which it is written."""

    identifier: int
    n_z: int
    n_y: int
    n_tower: int
    n_t: int
    dz: float
    dy: float
    dt: float
    mean_speed: float
    hub_height: float
    bottom: float
    u_slope: float
    u_offset: float
    v_slope: float
    v_offset: float
    w_slope: float
    w_offset: float
    n_description: int


_HEADER = struct.Struct("<h4i12fi")


def read_bts(path: str | os.PathLike[str]) -> WindRecord:
    r"""Longitudinal wind at the hub from a binary full field, TurbSim's ``.bts`` (``WrADFF``).

    The file is little endian. It holds a header (:class:`_FieldHeader`), a description, and 16-bit integers for every
    time step: those of the grid, with the components u, v, w fastest, y next and z slowest, then those of the tower. A
    velocity is :math:`v = (\mathrm{raw} - \mathrm{offset})/\mathrm{slope}`. The hub is at the middle of the grid's
    width and need not be a grid point: u is interpolated bilinearly between the four points around it.

    Args:
        path: path of the file.

    Raises:
        ValueError: if the file is not of this format, its length is not the one that its header implies, or the hub
            lies outside the grid; otherwise as in :class:`WindRecord`.

    Source: Jonkman, *TurbSim User's Guide*, NREL/TP-500-46198, appendix on binary full-field files.
    """
    header = _read_header(path)
    n_grid = header.n_z * header.n_y
    start = _HEADER.size + header.n_description
    shape = (header.n_t, n_grid + header.n_tower, 3)
    expected, found = start + 2 * math.prod(shape), os.path.getsize(path)
    if found != expected:
        state = "is truncated" if found < expected else "is too long"
        raise ValueError(
            f"{path}: {state}, it holds {found} bytes, but its header ({header.n_t} steps of "
            f"{header.n_z}x{header.n_y} grid and {header.n_tower} tower points) implies {expected} bytes. "
            "Copy the file again, in binary mode, or run TurbSim again."
        )
    # The field is mapped and not read, because it has hundreds of megabytes, of which the hub needs four columns. The
    # reader of openfast_toolbox and weio allocates what the header declares, in double precision, and checks no length.
    raw = np.memmap(path, dtype="<i2", mode="r", offset=start, shape=shape)
    z = _interpolation(path, (header.hub_height - header.bottom) / header.dz, header.n_z, "height")
    y = _interpolation(path, 0.5 * (header.n_y - 1), header.n_y, "width")
    corners = [a * b * raw[:, i * header.n_y + j, 0].astype(np.float64) for i, a in z for j, b in y]
    hub = np.sum(corners, axis=0)
    # The interval is stored in single precision; its shortest decimal is the number that TurbSim was given.
    dt = float(str(np.float32(header.dt)))
    return WindRecord(dt * np.arange(header.n_t), (hub - header.u_offset) / header.u_slope, str(path))


def _read_header(path: str | os.PathLike[str]) -> _FieldHeader:
    with open(path, "rb") as file:
        head = file.read(_HEADER.size)
    if len(head) < _HEADER.size:
        raise ValueError(
            f"{path}: is truncated, it holds {len(head)} bytes, but the header alone takes {_HEADER.size} bytes. "
            "Copy the file again or run TurbSim again."
        )
    header = _FieldHeader._make(_HEADER.unpack(head))
    if header.identifier not in (7, 8):
        raise ValueError(
            f"{path}: begins with the number {header.identifier}, but a TurbSim full field begins with 7 or 8 "
            "(periodic). Is it another format, such as Bladed's .wnd? Run TurbSim with WrADFF."
        )
    counts_right = min(header.n_z, header.n_y, header.n_t) >= 1 and min(header.n_tower, header.n_description) >= 0
    scales = (header.dz, header.dy, header.dt, header.u_slope)
    if not (counts_right and min(scales) > 0 and all(math.isfinite(value) for value in header)):
        raise ValueError(
            f"{path}: header is corrupt, {header}; counts and spacings must be positive and all values finite. "
            "Copy the file again, in binary mode, or run TurbSim again."
        )
    return header


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
