"""The benchmark's record: pump voltage in, level of the lower tank out, for estimation and for test."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Benchmark(NamedTuple):
    """Voltages and levels [V] at intervals of 4 s, of the estimation record and of the test record."""

    voltage: Float[np.ndarray, " samples"]
    level: Float[np.ndarray, " samples"]
    test_voltage: Float[np.ndarray, " samples"]
    test_level: Float[np.ndarray, " samples"]


COLUMNS = ("uEst", "yEst", "uVal", "yVal")


def read_benchmark(path: Path | None) -> Benchmark:
    """The record from a CSV file with the benchmark's columns, or else from the package ``nonlinear-benchmarks``.

    Raises:
        ValueError: if the file cannot be read or lacks a column or a number, or the package is not installed or cannot
            load the record.
    """
    if path is None:
        return _packaged()
    try:
        with open(path, encoding="utf-8") as file:
            header = [name.strip().strip('"') for name in file.readline().strip().split(",")]
            table = np.genfromtxt(file, delimiter=",", usecols=range(len(header)), filling_values=np.nan)
    except (OSError, ValueError) as error:
        raise ValueError(f"data={path} cannot be read: {error}") from error
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise ValueError(f"data={path} has the columns {', '.join(header)}; it needs {', '.join(missing)}, too.")
    columns = [np.atleast_2d(table)[:, header.index(name)] for name in COLUMNS]
    if not all(np.isfinite(column).all() for column in columns):
        raise ValueError(f"data={path}: a number is missing in the columns {', '.join(COLUMNS)}.")
    return Benchmark(*columns)


def _packaged() -> Benchmark:
    try:
        from nonlinear_benchmarks import Cascaded_Tanks
    except ImportError as error:
        raise ValueError(
            "the record needs a package: pip install nonlinear-benchmarks, or give a file, --data FILE."
        ) from error
    try:
        estimation, test = Cascaded_Tanks()
    except Exception as error:  # whatever a download can raise
        raise ValueError(
            f"the package nonlinear-benchmarks cannot load the record ({error}); give a file, --data FILE, with the "
            f"columns {', '.join(COLUMNS)}."
        ) from error
    return Benchmark(*(np.ravel(x).astype(float) for x in (estimation.u, estimation.y, test.u, test.y)))
