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
        ValueError: if the file cannot be read, or lacks a column or a number.
    """
    if path is None:
        from nonlinear_benchmarks import Cascaded_Tanks  # which downloads the record at its first use

        estimation, test = Cascaded_Tanks()
        return Benchmark(*(np.ravel(x).astype(float) for x in (estimation.u, estimation.y, test.u, test.y)))
    try:
        table = np.genfromtxt(path, delimiter=",", names=True, deletechars='"', encoding="utf-8", ndmin=1)
    except (OSError, ValueError, IndexError) as error:
        raise ValueError(f"data={path} cannot be read: {error}") from error
    names = table.dtype.names or ()
    if not (set(COLUMNS) <= set(names) and all(np.isfinite(table[name]).all() for name in COLUMNS)):
        raise ValueError(
            f"data={path} must have a number in every row of {', '.join(COLUMNS)}; it has {', '.join(names)}."
        )
    return Benchmark(*(table[name] for name in COLUMNS))
