"""Tables of the study, as Markdown."""

from typing import Any

import numpy as np

from rt_torchrl.figures.style import with_unit
from rt_torchrl.study.results import HALVES, Entry, difference, named, numeric

COST_HEADER = ["J_a", "95 % interval"]
TWIN_HEADER = ["J_p ratio", "weight error"]
PAPER = {
    "wind_turbine": ("(2.1 ± 0.8)e-1", "(0.8 ± 0.5)e-1", "(1.3 ± 1.2)e-1"),
    "flapping_wing": ("(3.2 ± 4.9)e-2", "(4.18 ± 0.01)e-1", "(2.01 ± 0.45)e-1"),
    "cryogenic_tank": ("(3.15 ± 0.9)e-4", "(4.47 ± 2.68)e-1", "(4.80 ± 3.15)e-1"),
}
"""The paper's table of learning performance: ratios of J_p, of J_a model-based and of J_a model-free."""
RATIOS = (("J_p_before", "J_p"), ("J_a_before", "J_a_model_based"), ("J_a_before", "J_a_model_free"))
"""Costs before and after training, whose ratios the table gives."""


def shown(name: str) -> str:
    """The name of a plant, an arm or a yardstick as a reader sees it."""
    return name.replace("_", " ")


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def nominal_table(entries: list[Entry], limits: list[Entry]) -> str:
    """J_a of every arm and yardstick of a plant, its interval and ratio to the oracle's, and the plant's quantities.

    Args:
        entries: arms and yardsticks on all unseen episodes.
        limits: the limit and model predictive control on the first of them, on which every ratio to the limit is taken;
            may be empty.
    """
    oracle = named(entries)["oracle"]
    best = named(limits).get("limit")
    header = ["", *COST_HEADER, "over oracle", *(["over limit"] if best else [])]
    header += [*oracle.merit, *TWIN_HEADER, "episodes to 110 %"]
    rows = []
    for entry in (*entries, *limits):
        reached = ", ".join("never" if k is None else str(k) for k in entry.episodes_to(oracle.mean))
        cells = [shown(entry.name), *cost_cells(entry), f"{entry.over(oracle):.3f}"]
        cells += [f"{entry.over(best):.3f}"] if best else []
        rows.append([*cells, *merit_cells(entry), *twin_cells(entry), reached or "–"])
    return table(header, rows)


def variant_table(variants: dict[str, list[Entry]], nominal: list[Entry]) -> str:
    """J_a of every arm under every variant, its interval and ratio to the arm's nominal J_a, and the same quantities.

    Args:
        variants: entries of a plant by variant.
        nominal: entries of the same plant as it is.
    """
    before = {entry.name: entry.mean for entry in nominal}
    header = ["", "", *COST_HEADER, "over nominal", *nominal[0].merit, *TWIN_HEADER]
    rows = []
    for variant, entries in variants.items():
        for entry in entries:
            cells = [variant, shown(entry.name), *cost_cells(entry), f"{entry.mean / before[entry.name]:.3f}"]
            rows.append([*cells, *merit_cells(entry), *twin_cells(entry)])
    return table(header, rows)


def difference_table(variants: dict[str, list[Entry]]) -> str:
    """95 % intervals of the J_a of twinning, with each policy, minus that of its halves and of classical controllers.

    A negative interval says that twinning costs less, and one that holds zero that nothing is shown.

    Args:
        variants: entries of a plant by variant, with the nominal ones.
    """
    rows = []
    for variant, entries in variants.items():
        others = [entry for entry in entries if not entry.name.startswith(("twinning", "oracle"))]
        for arm in (entry for entry in entries if entry.name.startswith("twinning")):
            for other in others:
                if other.name not in HALVES or arm.name == "twinning":  # the halves have its policy
                    low, high = difference(arm, other)
                    rows.append([variant, shown(arm.name), shown(other.name), f"{low:.3g} … {high:.3g}"])
    return table(["", "", "minus", "95 % interval"], rows)


def paper_table(summaries: dict[str, list[dict[str, Any]]]) -> str:
    """The paper's table of learning performance beside ours: cost after training over the mean cost before.

    Args:
        summaries: ``summary`` of ``metrics.json`` of every twinning run, by plant.
    """
    header = ["", "J_p, paper", "here", "J_a model-based, paper", "here", "J_a model-free, paper", "here"]
    rows = []
    for plant, found in summaries.items():
        unseen = [summary["unseen"] for summary in found]
        cells = [shown(plant)]
        for printed, (before, after) in zip(PAPER.get(plant, ("–",) * 3), RATIOS, strict=True):
            start = np.mean([numeric(part[before]["mean"]) for part in unseen])
            ratios = np.array([numeric(part[after]["mean"]) for part in unseen]) / start
            deviation = f" ± {ratios.std(ddof=1):.1g}" if len(ratios) > 1 else ""
            cells += [printed, f"{ratios.mean():.2g}{deviation}"]
        rows.append(cells)
    return table(header, rows)


def cost_cells(entry: Entry) -> list[str]:
    """Cells under ``COST_HEADER``."""
    low, high = entry.interval()
    return [f"{entry.mean:.4g}", f"{low:.4g} … {high:.4g}"]


def merit_cells(entry: Entry) -> list[str]:
    """Cells of the plant's own quantities."""
    return [f"{value:.4g}" for value in entry.merit.values()]


def twin_cells(entry: Entry) -> list[str]:
    """Cells under ``TWIN_HEADER``: the mean ratio over the seeds, and the greatest error of all seeds."""
    ratio = f"{np.mean(entry.J_p_ratio):.1e}" if entry.J_p_ratio else "–"
    return [ratio, with_unit(100 * max(entry.weight_error), "%") if entry.weight_error else "–"]
