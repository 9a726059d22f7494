"""Finished runs side by side: those that differ in nothing but the seed are one row, with an interval."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rt_torchrl.figures.style import REAL, REFERENCE_LINE, ROLES, caption, legend_below, panels
from rt_torchrl.runs.results import judged_on_the_system, on_the_twin
from rt_torchrl.runs.settings import BESIDE, read_settings
from rt_torchrl.study.results import Entry, merit_means, numbers

APART = (*BESIDE, "seed", "log_dir", "resume", "overwrite", "threads", "config", "loggers")
"""Settings in which runs of one row may differ."""
COLOURS = (REAL, ROLES["model_based"], ROLES["model_free"], "#CC79A7", "#56B4E9", "#7f3c8d", "#a0522d", "#6b8e23")
MARKERS = "os^Dv"
WIDEST_LINEAR = 5.0
"""Ratio of the greatest to the least cost above which the axis is logarithmic."""


def entries_of(folders: Sequence[Path]) -> tuple[list[Entry], list[Entry]]:
    """Rows of a comparison: one for each set of options, then one for each classical controller.

    The policy counts that the referee prefers at the end. All runs must have been judged on the same unseen episodes of
    one plant.

    Args:
        folders: folders of finished runs.

    Returns:
        Entries of the runs and of the controllers. ``curves`` hold J_a on the unseen episodes after each real episode
        (``--unseen-every 1``), and where a run has none, the costs of its real episodes.

    Raises:
        ValueError: if a folder holds no finished run, or the runs cannot be compared.
    """
    settings = [read_settings(folder) for folder in folders]
    found = [_metrics(folder) for folder in folders]
    for name, values in (
        ("plant", [one["plant"] for one in settings]),
        ("number of unseen episodes", [judged_on_the_system(one["summary"])[0]["episodes"] for one in found]),
        ("place of the unseen episodes", [_place(one["summary"]) for one in found]),
    ):
        if len(set(values)) > 1:
            raise ValueError(f"the runs differ in their {name} ({', '.join(map(str, values))}); compare runs of one.")
    kinds = _kinds(settings)
    grouped = {kind: [one for one, its in zip(found, kinds, strict=True) if its == kind] for kind in kinds}
    controllers: dict[str, dict[str, Any]] = {}
    for one in found:
        unseen, _ = judged_on_the_system(one["summary"])
        for name, result in unseen["baselines"].items():
            controllers.setdefault(name, {"costs": unseen["costs"][name], "merit": result["merit"]})
    runs = [_entry(kind, group) for kind, group in grouped.items()]
    return runs, [
        Entry(name=name, costs=np.array([numbers(one["costs"])]), merit=merit_means(one["merit"]))
        for name, one in controllers.items()
    ]


def comparison_table(runs: Sequence[Entry], controllers: Sequence[Entry]) -> str:
    """The rows as text: seeds, J_a with its 95 % interval over seeds and episodes, and the plant's own quantities."""
    every = [*runs, *controllers]
    width = max(len(entry.name) for entry in every) + 2
    merits = list(every[0].merit)
    lines = [f"{'':<{width}}{'seeds':>5}{'J_a':>11}   {'95 % interval':<22}" + "".join(f"  {m}" for m in merits)]
    for entry in every:
        low, high = entry.interval()
        seeds = len(entry.costs) if entry.curves else ""
        cells = "".join(f"  {entry.merit[m]:>{len(m)}.4g}" for m in merits)
        lines.append(f"{entry.name:<{width}}{seeds:>5}{entry.mean:>11.5g}   {f'{low:.4g} … {high:.4g}':<22}{cells}")
    return "\n".join(lines)


def comparison_figure(runs: Sequence[Entry], controllers: Sequence[Entry], title: str) -> Figure:
    """J_a over the real episodes: a line for each set of options through the mean of its seeds, a band over them.

    Classical controllers are horizontal lines.
    """
    figure, ((ax,),) = panels(1, title=title, size=(8.5, 4.4))
    for row, (entry, colour) in enumerate(zip(runs, COLOURS * len(runs), strict=False)):
        length = min(map(len, entry.curves))
        curves = np.array([curve[:length] for curve in entry.curves])
        number = np.arange(1, length + 1)
        ax.fill_between(number, curves.min(0), curves.max(0), color=colour, alpha=0.15, linewidth=0)
        # Earlier rows are wider, so that a later one that runs on top of them hides none.
        look: dict[str, Any] = {"linewidth": max(1.2, 3.2 - row), "marker": MARKERS[row % len(MARKERS)]}
        ax.plot(number, curves.mean(0), color=colour, markersize=4, label=entry.name, **look)
    for entry, dash in zip(controllers, ("--", ":", "-.") * len(controllers), strict=False):
        ax.axhline(entry.mean, label=entry.name, **REFERENCE_LINE | {"linestyle": dash})
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in ax.lines])
    if values.min() > 0.0 and values.max() > WIDEST_LINEAR * values.min():
        ax.set_yscale("log")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("real episodes")
    caption(ax, "control cost $J_a$", "mean of the seeds; band: their range")
    legend_below(figure, [ax])
    return figure


def _metrics(folder: Path) -> dict[str, Any]:
    file = folder / "metrics.json"
    if not file.is_file():
        raise ValueError(f"the run in {folder} has no metrics.json: it is not finished; go on with it by --resume.")
    try:
        found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file} is damaged: {error}") from error
    return found


def _kinds(settings: Sequence[dict[str, Any]]) -> list[str]:
    """Name of each run's options: those in which it differs from other runs, but for the seed."""
    flat = [_flat({key: value for key, value in one.items() if key not in APART}) for one in settings]
    keys = dict.fromkeys(key for one in flat for key in one)
    differing = [key for key in keys if len({json.dumps(one.get(key)) for one in flat}) > 1]
    if not differing:
        return [str(settings[0]["plant"]).replace("_", " ")] * len(settings)
    return [", ".join(f"{key.removeprefix('twinning.')} {_shown(one.get(key))}" for key in differing) for one in flat]


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in settings.items():
        found |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def _shown(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value).replace("_", "-")


def _place(summary: dict[str, Any]) -> str:
    return "real system" if on_the_twin(summary["unseen"]) else "simulation"


def _entry(kind: str, found: list[dict[str, Any]]) -> Entry:
    unseen = [judged_on_the_system(one["summary"]) for one in found]
    merits = [merit_means(one["merit"][live]) for one, live in unseen]
    return Entry(
        name=kind,
        costs=np.array([numbers(one["costs"][live]) for one, live in unseen]),
        merit={name: float(np.mean([merit[name] for merit in merits])) for name in merits[0]},
        curves=[_curve(one["episodes"]) for one in found],
    )


def _curve(episodes: list[dict[str, Any]]) -> list[float]:
    judged = all("J_a_unseen" in episode for episode in episodes)
    return numbers(episode["J_a_unseen" if judged else "real_cost"] for episode in episodes)
