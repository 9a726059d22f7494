"""The benchmark's record: pump voltage in, level of the lower tank out, for estimation and for test."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

COLUMNS = {"estimation": ("uEst", "yEst"), "test": ("uVal", "yVal")}
"""Columns of voltage and level [V] at intervals of 4 s, of each record."""


def read_benchmark(
    path: Path | None,
) -> dict[str, tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]]:
    """Voltage and level of each record, from a CSV file with its columns, or else from ``nonlinear-benchmarks``.

    Raises:
        ValueError: if the file cannot be read, or lacks a column or a number.
    """
    if path is None:
        from nonlinear_benchmarks import Cascaded_Tanks  # which downloads the record at its first use

        parts = zip(COLUMNS, Cascaded_Tanks(), strict=True)
        return {name: (np.ravel(part.u).astype(float), np.ravel(part.y).astype(float)) for name, part in parts}
    try:
        table = np.genfromtxt(path, delimiter=",", names=True, deletechars='"', encoding="utf-8", ndmin=1)
    except (OSError, ValueError, IndexError) as error:
        raise ValueError(f"data={path} cannot be read: {error}") from error
    needed, names = [column for pair in COLUMNS.values() for column in pair], table.dtype.names or ()
    if not (set(needed) <= set(names) and all(np.isfinite(table[name]).all() for name in needed)):
        raise ValueError(
            f"data={path} must have a number in every row of {', '.join(needed)}; it has {', '.join(names)}."
        )
    return {name: (table[voltage], table[level]) for name, (voltage, level) in COLUMNS.items()}
