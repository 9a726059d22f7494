"""What the study found, in sentences and tables."""

import os
from importlib.metadata import version
from typing import Any

import numpy as np

from rt_torchrl.study import variants
from rt_torchrl.study.captions import title
from rt_torchrl.study.figures import shown
from rt_torchrl.study.findings import Entry, Results, named
from rt_torchrl.study.page import table
from rt_torchrl.study.rows import COST_HEADER, TWIN_HEADER, compared, cost_cells, merit_cells, twin_cells

CLOSE = 1.05
"""Twinning's mean over the oracle's that counts as having reached it."""
PAPER = {
    "wind_turbine": ("(2.1 ± 0.8)e-1", "(0.8 ± 0.5)e-1", "(1.3 ± 1.2)e-1"),
    "flapping_wing": ("(3.2 ± 4.9)e-2", "(4.18 ± 0.01)e-1", "(2.01 ± 0.45)e-1"),
    "cryogenic_tank": ("(3.15 ± 0.9)e-4", "(4.47 ± 2.68)e-1", "(4.80 ± 3.15)e-1"),
}
"""The paper's table of learning performance: ratios of J_p, of J_a model-based and of J_a model-free."""
PAPER_TEXT = "Cost after training over the mean cost before, over the seeds of twinning; the paper has five."
CAUSES = {
    "wind_turbine": "The paper's policy has no bias: without an error it asks for half of the greatest torque and of "
    "the greatest pitch, whatever its weights. The other policies are trained in the same way and need not.",
    "flapping_wing": "The paper's policy and a PD law around trim are the same affine law. Exact gradients on as many "
    "gusts as a training meets bring it to the PD law's cost, on twice as many below (see the figure over the episodes "
    "planned on): twinning lacks not gusts but convergence of its plans, five steps of Adam an episode. The perceptron "
    "is trained as the paper's policy is.",
    "cryogenic_tank": "A vent that is either shut or fully open loses less gas for the same heat than one that is "
    "half open. A law of the pressure error can do that only by chattering, at a gain several hundred times that of "
    "its best smooth form, and costs more at the gains in between (see the figure over K_P): a descent from a smooth "
    "law, twinning's or the oracle's, ends on the near side.",
}
"""Why a plant's policy falls short of a classical controller."""


def merit_table(entries: list[Entry]) -> str:
    """Every arm and yardstick of a plant with J_a, its interval, the regret and the plant's own quantities."""
    oracle = named(entries)["oracle"]
    header = ["", *COST_HEADER, "over oracle", *oracle.merit, *TWIN_HEADER, "episodes to 110 %"]
    rows = []
    for entry in entries:
        cells = [shown(entry.name), *cost_cells(entry), f"{entry.mean / oracle.mean:.3f}"]
        reached = entry.episodes_to(oracle.mean)
        cells += [*merit_cells(entry), *twin_cells(entry)]
        cells += [", ".join("never" if k is None else str(k) for k in reached) if reached else "–"]
        rows.append(cells)
    return table(header, rows)


def verdicts(entries: list[Entry]) -> str:
    """The study's targets, each with what was found."""
    found = named(entries)
    twinning, oracle = found["twinning"], found["oracle"]
    share = twinning.mean / oracle.mean
    lines = [f"- Within 5 % of the oracle: **{'yes' if share <= CLOSE else 'no'}** ({share:.3f})."]
    for half in variants.HALVES:
        if half in found:
            lines.append(f"- Against {shown(half)} alone: {compared(twinning, found[half])}.")
    contenders = [entry for entry in entries if entry.name.startswith("twinning")]
    classical = [entry for entry in entries if not entry.curves and entry.name != "oracle"]
    for contender in contenders:
        for entry in classical:
            pair = f"{shown(contender.name).capitalize()} against the classical {shown(entry.name)}"
            lines.append(f"- {pair}: {compared(contender, entry)}.")
    return "\n".join(lines)


def paper_table(summaries: dict[str, list[dict[str, Any]]]) -> str:
    """The paper's table of learning performance beside ours: cost after over mean cost before, over the seeds.

    Args:
        summaries: ``summary`` of ``metrics.json`` of every twinning run, by plant.
    """
    header = ["", "J_p, paper", "here", "J_a model-based, paper", "here", "J_a model-free, paper", "here"]
    rows = []
    for plant, found in summaries.items():
        unseen = [summary["unseen"] for summary in found]
        pairs = (("J_p_before", "J_p"), ("J_a_before", "J_a_model_based"), ("J_a_before", "J_a_model_free"))
        cells = [shown(plant)]
        for printed, (before, after) in zip(PAPER.get(plant, ("–",) * 3), pairs, strict=True):
            start = np.mean([part[before]["mean"] for part in unseen])
            ratios = np.array([part[after]["mean"] for part in unseen]) / start
            deviation = f" ± {ratios.std(ddof=1):.1g}" if len(ratios) > 1 else ""
            cells += [printed, f"{ratios.mean():.2g}{deviation}"]
        rows.append(cells)
    return table(header, rows)


def sections(results: Results, *, figures: list[str], quick: bool, command: str) -> list[str]:
    """The report's Markdown, section by section.

    Args:
        results: what was found.
        figures: Markdown of every figure with its caption.
        quick: mark the report as made from short trainings.
        command: that makes the report.
    """
    found = [
        f"Made by `{command}`, rt_torchrl {version('rt_torchrl')}, {os.cpu_count()} cores. Every cost is a mean over "
        "unseen episodes on the real plant, the same for all."
    ]
    if quick:
        found.append(
            "**Made with `--quick`, from short trainings and short episodes: the report's form, but no result.**"
        )
    for plant, entries in results.entries.items():
        found += [f"## {title(plant)}", merit_table(entries), verdicts(entries)]
        found += [CAUSES[plant]] if plant in CAUSES else []
    found += ["## The paper's table of learning performance", PAPER_TEXT, paper_table(results.summaries)]
    if any(results.variants.values()):
        found += ["## Sensor noise and model error", variants.TEXT]
        for plant, harder in results.variants.items():
            found += [f"### {title(plant)}", variants.merit_table(harder, results.entries[plant])]
            found += [variants.verdicts(harder)]
    return [*found, "## Figures", *figures]


def numbers(results: Results) -> dict[str, Any]:
    """What ``study.json`` holds."""
    return {
        plant: {
            "entries": {entry.name: numbers_of(entry) for entry in entries},
            "variants": {
                variant: {entry.name: numbers_of(entry) for entry in harder}
                for variant, harder in results.variants[plant].items()
            },
        }
        for plant, entries in results.entries.items()
    }


def numbers_of(entry: Entry) -> dict[str, Any]:
    """What ``study.json`` holds of a row."""
    return {
        "J_a": entry.mean,
        "confidence_interval": entry.interval(),
        "J_a_of_each_seed": entry.costs.mean(1).tolist(),
        "merit": entry.merit,
        "J_p_ratio": entry.J_p_ratio,
        "weight_error": entry.weight_error,
        "J_a_unseen": entry.curves,
        "J_p": entry.twin_errors,
    }
