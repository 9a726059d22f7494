"""The report as Markdown, as one HTML page that holds its figures, and as numbers."""

import base64
import json
import os
import re
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import markdown
from jinja2 import Environment, PackageLoader, StrictUndefined

from rt_torchrl.atomic_file import finite
from rt_torchrl.study.names import shown, title
from rt_torchrl.study.results import HALVES, Entry, Results, difference, named
from rt_torchrl.study.tables import nominal_table, paper_table, variant_table

HEADING = "What reinforcement twinning is worth"


class CaptionedFigure(NamedTuple):
    """A figure of the report: its ``path`` relative to the report's folder, and its ``caption``."""

    path: Path
    caption: str


def write(
    folder: Path,
    results: Results,
    *,
    figures: list[CaptionedFigure],
    quick: bool,
    command: str,
    unknown: Mapping[str, tuple[str, ...]] | None = None,
) -> tuple[Path, Path]:
    """Write ``README.md``, ``report.html`` and ``study.json``. ``report.md.jinja`` holds the sentences.

    Args:
        folder: folder of the report.
        results: results of the study.
        figures: figures in the order of the report.
        quick: whether to mark the report as one of short trainings.
        command: the command that makes the report.
        unknown: what the real system of each plant has beside its twin, by names; None for what the twins know.

    Returns:
        Paths of the Markdown and of the page.
    """
    loader = PackageLoader("rt_torchrl.study", package_path="")
    templates = Environment(loader=loader, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    templates.filters |= {"shown": shown, "title": title}
    templates.globals |= {"named": named, "compared": compared, "halves": HALVES, "heading": HEADING}
    templates.globals |= {f.__name__: f for f in (nominal_table, variant_table, paper_table)}
    made: dict[str, Any] = {
        "command": command,
        "version": version("rt_torchrl"),
        "cores": os.cpu_count(),
        "quick": quick,
    }
    made["unknown"] = {plant: (unknown or {}).get(plant, ()) for plant in results.entries}
    text = templates.get_template("report.md.jinja").render(results=results, figures=figures, **made)
    body = markdown.markdown(text, extensions=["tables", "fenced_code"])
    body = re.sub(r'src="([^"]+\.png)"', lambda found: f'src="{embedded(folder / found[1])}"', body)
    source, page = folder / "README.md", folder / "report.html"
    source.write_text(text)
    page.write_text(templates.get_template("report.html.jinja").render(body=body))
    (folder / "study.json").write_text(json.dumps(finite(numbers(results, made["unknown"])), indent=2) + "\n")
    return source, page


def compared(first: Entry, second: Entry) -> str:
    """Whether ``first`` costs less than ``second``, more, or neither with 95 % confidence; and the interval."""
    low, high = difference(first, second)
    word = "better" if high < 0 else "worse" if low > 0 else "neither better nor worse"
    return f"**{word}** (difference {low:.3g} … {high:.3g})"


def embedded(path: Path) -> str:
    """The data URI of a PNG file."""
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()


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
