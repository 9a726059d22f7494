"""Cells that the study's tables have in common, and the word for a difference."""

import numpy as np

from rt_torchrl.figures.style import with_unit
from rt_torchrl.study.findings import Entry, difference

COST_HEADER = ["J_a", "95 % interval"]
TWIN_HEADER = ["J_p ratio", "weight error"]


def cost_cells(entry: Entry) -> list[str]:
    """Under ``COST_HEADER``."""
    low, high = entry.interval()
    return [f"{entry.mean:.4g}", f"{low:.4g} … {high:.4g}"]


def merit_cells(entry: Entry) -> list[str]:
    """The plant's own quantities."""
    return [f"{value:.4g}" for value in entry.merit.values()]


def twin_cells(entry: Entry) -> list[str]:
    """Under ``TWIN_HEADER``: mean over the seeds, and the worst of them."""
    ratio = f"{np.mean(entry.J_p_ratio):.1e}" if entry.J_p_ratio else "–"
    return [ratio, with_unit(100 * max(entry.weight_error), "%") if entry.weight_error else "–"]


def compared(first: Entry, second: Entry) -> str:
    """Whether ``first`` costs less than ``second`` beyond the interval of the difference, which it gives too."""
    low, high = difference(first, second)
    word = "better" if high < 0 else "worse" if low > 0 else "neither better nor worse"
    return f"**{word}** (difference {low:.3g} … {high:.3g})"
