"""The page of the study: its tables as Markdown, its figures, and all numbers as JSON."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rt_torchrl.atomic_file import finite
from rt_torchrl.study.results import Entry, Results
from rt_torchrl.study.tables import difference_table, nominal_table, paper_table, shown, variant_table


def write(
    folder: Path,
    results: Results,
    *,
    figures: Sequence[Path],
    quick: bool,
    command: str,
    unknown: Mapping[str, tuple[str, ...]] | None = None,
) -> Path:
    """Write the tables and figures into ``README.md`` and all numbers into ``study.json``.

    Args:
        folder: folder of the page.
        results: results of the study.
        figures: paths of the figures relative to the folder.
        quick: whether to mark the page as one of short trainings.
        command: the command that makes the page.
        unknown: what the real system of each plant has beside its twin, by names; None for what the twins know.

    Returns:
        Path of the Markdown.
    """
    unknown = {plant: (unknown or {}).get(plant, ()) for plant in results.entries}
    page = ["# What reinforcement twinning is worth"]
    page.append(f"Made by `{command}`. Every J_a is a mean over the same unseen episodes on the real system.")
    if quick:
        page.append("**The trainings of `--quick` are short: this page shows the form and is no result.**")
    for plant in results.entries:
        page += _section(plant, results, unknown[plant])
    if not any(unknown.values()):
        page += ["## Cost after training over the cost before, beside the paper", paper_table(results.summaries)]
    page += [f"![{path.stem}]({path.as_posix()})" for path in figures]
    folder.mkdir(parents=True, exist_ok=True)
    source = folder / "README.md"
    source.write_text("\n\n".join(page) + "\n", encoding="utf-8")
    (folder / "study.json").write_text(json.dumps(finite(numbers(results, unknown)), indent=2) + "\n")
    return source


def _section(plant: str, results: Results, unknown: tuple[str, ...]) -> list[str]:
    """Heading and tables of a plant."""
    entries, limits, variants = results.entries[plant], results.limits[plant], results.variants[plant]
    beside = f" with {' and '.join(unknown)}" if unknown else ""
    parts = [f"## {shown(plant).capitalize()}{beside}", nominal_table(entries, limits)]
    for entry in limits:
        clock = "" if entry.milliseconds is None else f"; a solve took {entry.milliseconds:.3g} ms in the median"
        parts.append(f"`{entry.name}`: on the first {entry.costs.shape[1]} unseen episodes{clock}.")
    parts += ["Differences of J_a, paired by episode:", difference_table({"nominal": entries} | variants)]
    if variants:
        parts += ["### Sensor noise and model error", variant_table(variants, entries)]
    return parts


def numbers(results: Results, unknown: Mapping[str, tuple[str, ...]]) -> dict[str, Any]:
    """Content of ``study.json``; ``unknown`` is what the real system of each plant has beside its twin."""
    return {
        plant: {
            "unknown": unknown[plant],
            "entries": {entry.name: numbers_of(entry) for entry in entries},
            "limits": {entry.name: numbers_of(entry) for entry in results.limits[plant]},
            "variants": {
                variant: {entry.name: numbers_of(entry) for entry in harder}
                for variant, harder in results.variants[plant].items()
            },
        }
        for plant, entries in results.entries.items()
    }


def numbers_of(entry: Entry) -> dict[str, Any]:
    """Content of ``study.json`` for one entry."""
    return {
        "J_a": entry.mean,
        "confidence_interval": entry.interval(),
        "J_a_of_each_seed": entry.costs.mean(1).tolist(),
        "merit": entry.merit,
        "J_p_ratio": entry.J_p_ratio,
        "weight_error": entry.weight_error,
        "J_a_unseen": entry.curves,
        "J_p": entry.twin_errors,
        "episodes": entry.costs.shape[1],
        "milliseconds": entry.milliseconds,
    }
