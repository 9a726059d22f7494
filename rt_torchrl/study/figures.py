"""Figures of the study: how arms learn, and what they cost on the unseen episodes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rt_torchrl.figures.style import REAL, REFERENCE, REFERENCE_LINE, ROLES, TWIN, caption, legend_below, panels
from rt_torchrl.study.results import Entry, Results, named
from rt_torchrl.study.tables import shown
from rt_torchrl.study.training import CHANGED
from rt_torchrl.study.yardstick import Yardstick

ARMS: dict[str, str] = {"twinning": REAL, **dict(ROLES.items())}
ARM_SHIFT = {"twinning": -0.2, "model_based": 0.0, "model_free": 0.2}
POLICIES = ("#7f3c8d", "#a0522d", "#e75480", "#6b8e23")
"""Colours of twinning with other policies, in the order of the policies."""
DASHES = ("--", ":", "-.", (0, (1, 1)), (0, (8, 1)))
YARDSTICK_LINE = {"color": REFERENCE, "linewidth": 1.2}
WIDEST_LINEAR = 5.0
"""Ratio of the greatest to the least cost above which an axis is logarithmic."""
WIDEST_LINEAR_SPAN = 50.0
"""Ratio of the greatest to the least abscissa above which its axis is logarithmic."""


def draw(folder: Path, results: Results, lines: Mapping[str, Yardstick]) -> list[Path]:
    """Draw what there are results for into the folder ``figures``; return the paths relative to ``folder``.

    Args:
        folder: folder of the page.
        results: results of the study.
        lines: costs along one quantity, of the plants that have some.
    """
    drawn = {"learning": learning(results.entries), "robustness": robustness(results.entries)}
    if any(results.limits.values()):
        drawn["limits"] = limits(results.entries, results.limits)
    if any(results.variants.values()):
        drawn["variants"] = variants(results.entries, results.variants)
    if any(CHANGED in of_plant for of_plant in results.variants.values()):
        drawn["following"] = following(results.entries, results.variants)
    for plant, line in lines.items():
        drawn[f"{plant}_{line.path.stem}"] = cost_line(line.run(), results.entries[plant])
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in drawn.items():
        paths.append(Path("figures") / f"{name}.png")
        figure.savefig(folder / paths[-1], dpi=110)
    return paths


def learning(entries: dict[str, list[Entry]]) -> Figure:
    """J_a of the live policy on the unseen episodes over the real episodes: mean and range of the seeds, by plant.

    The oracle is a dashed line, and the classical controllers are thin lines.

    Args:
        entries: entries of each plant.
    """
    title = "Cost on unseen episodes while training; band: range of the seeds"
    figure, axes = panels(1, len(entries), title=title, size=(max(7.5, 4.6 * len(entries)), 4.0))
    colours = _colours([entry for found in entries.values() for entry in found])
    for ax, (plant, found) in zip(axes.flat, entries.items(), strict=True):
        for entry in found:
            if entry.curves and entry.curves[0]:
                _spread(ax, entry.curves, color=colours[entry.name], label=shown(entry.name))
            elif entry.name == "oracle":
                ax.axhline(entry.mean, label="oracle", **REFERENCE_LINE)
            else:
                ax.axhline(entry.mean, label="classical", linestyle=":", **YARDSTICK_LINE)
        ax.set_yscale("log")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.set_xlabel("real episodes")
        caption(ax, f"{shown(plant)}: $J_a$")
    legend_below(figure, list(axes.flat))
    return figure


def robustness(entries: dict[str, list[Entry]]) -> Figure:
    """Distribution of J_a over the unseen episodes (all seeds together), a violin for every arm and yardstick."""
    title = "Cost over the unseen episodes; bar: mean"
    figure, axes = panels(len(entries), title=title, size=(9.0, 2.9 * len(entries)))
    colours = _colours([entry for found in entries.values() for entry in found])
    for ax, (plant, found) in zip(axes.flat, entries.items(), strict=True):
        costs = [entry.costs.ravel() for entry in found]
        violins = ax.violinplot(costs, showmeans=False, showextrema=True, widths=0.8)
        for body, entry in zip(violins["bodies"], found, strict=True):
            body.set_facecolor(colours[entry.name])
        _bars(ax, [values.mean() for values in costs])
        together = np.concatenate(costs)
        if together.min() > 0 and together.max() > WIDEST_LINEAR * together.min():
            ax.set_yscale("log")
        ax.set_xticks(range(1, len(found) + 1), [shown(entry.name).replace(", ", ",\n") for entry in found])
        caption(ax, f"{shown(plant)}: $J_a$")
    return figure


def limits(entries: dict[str, list[Entry]], known: dict[str, list[Entry]]) -> Figure:
    """J_a over the clairvoyant optimum on the same episodes: a bar for every arm, controller and predictive control.

    Args:
        entries: entries of each plant.
        known: entries ``limit`` and ``mpc`` of each plant, on the first of the unseen episodes.
    """
    height = 1.0 + 0.32 * max(len(found) + len(known[plant]) for plant, found in entries.items())
    size = (max(7.5, 5.2 * len(entries)), max(3.0, height))
    figure, axes = panels(1, len(entries), title="How far from the best possible: cost over the limit", size=size)
    for ax, (plant, found) in zip(axes.flat, entries.items(), strict=True):
        best, colours = named(known[plant])["limit"], _colours([*found, *known[plant]])
        rows = sorted((entry for entry in (*found, *known[plant]) if entry is not best), key=lambda e: -e.over(best))
        ratios = [entry.over(best) for entry in rows]
        bars = ax.barh(range(len(rows)), ratios, color=[colours[entry.name] for entry in rows], height=0.7)
        ax.bar_label(bars, [f"{ratio:.3g}" for ratio in ratios], padding=3, fontsize=8)
        ax.set_yticks(range(len(rows)), [shown(entry.name) for entry in rows])
        if max(ratios) > WIDEST_LINEAR:
            ax.set_xscale("log")
        ax.margins(x=0.15)
        ax.set_xlim(left=1.0)  # the limit itself
        caption(ax, f"{shown(plant)}: $J_a$ over the limit, on its {best.costs.shape[1]} episodes")
    return figure


def variants(entries: dict[str, list[Entry]], harder: dict[str, dict[str, list[Entry]]]) -> Figure:
    """Mean J_a of every arm under sensor noise and model error over twinning's nominal mean, a point for every seed.

    Args:
        entries: entries of each plant as it is.
        harder: entries of each plant and variant.
    """
    what = "Noise and model error" if any(CHANGED in found for found in harder.values()) else "Noise"
    title = f"{what}: $J_a$ over twinning's nominal mean; a point for each seed"
    size = (max(7.5, 4.6 * len(entries)), 4.2)
    figure, axes = panels(1, len(entries), title=title, size=size, sharey=True)
    for ax, (plant, nominal) in zip(axes.flat, entries.items(), strict=True):
        columns = {"nominal": nominal} | harder[plant]
        unit = named(nominal)["twinning"].mean
        for column, found in enumerate(columns.values()):
            for arm in (entry for entry in found if entry.name in ARMS):
                means, place = arm.costs.mean(1) / unit, column + ARM_SHIFT[arm.name]
                label = shown(arm.name) if column == 0 else None
                ax.plot([place] * len(means), means, "o", color=ARMS[arm.name], alpha=0.7, markersize=5, label=label)
        ax.axhline(1.0, **REFERENCE_LINE)
        ax.set_xticks(range(len(columns)), list(columns), rotation=30, ha="right")
        ax.set_yscale("log")
        caption(ax, shown(plant))
    legend_below(figure, list(axes.flat))
    return figure


def following(entries: dict[str, list[Entry]], harder: dict[str, dict[str, list[Entry]]]) -> Figure:
    """J_p of twinning's twin after each real episode, on the system that the twin knows and with model error, by plant.

    Args:
        entries: entries of each plant as it is.
        harder: entries of each plant and variant; ``model error`` is shown.
    """
    size = (max(7.5, 4.6 * len(entries)), 3.8)
    figure, axes = panels(1, len(entries), title="The twin's error after each real episode", size=size)
    for ax, (plant, nominal) in zip(axes.flat, entries.items(), strict=True):
        for label, found, colour in (("nominal", nominal, REAL), (CHANGED, harder[plant][CHANGED], TWIN)):
            _spread(ax, named(found)["twinning"].twin_errors, color=colour, label=label)
        ax.set_yscale("log")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.set_xlabel("real episodes")
        caption(ax, f"{shown(plant)}: $J_p$")
    legend_below(figure, list(axes.flat))
    return figure


def cost_line(found: dict[str, Any], entries: list[Entry]) -> Figure:
    """J_a over one quantity, between the arms and yardsticks of the plant.

    Args:
        found: result of :func:`rt_torchrl.study.yardsticks.cost_along_gain` or ``cost_over_episodes``.
        entries: entries of the plant; twinning, oracle and the classical controllers are drawn as levels.
    """
    figure, axes = panels(1, title=f"Cost over {found['name']}, all else as it is", size=(8.0, 4.0))
    ax = axes[0, 0]
    ax.plot(found["values"], found["costs"], "o-", color=REAL, markersize=4)
    levels = [entry for entry in entries if entry.name in ("twinning", "oracle") or not entry.curves]
    for k, entry in enumerate(levels):
        line = {"linestyle": DASHES[k % len(DASHES)], "color": _colours(entries)[entry.name], "linewidth": 1.2}
        ax.axhline(entry.mean, label=shown(entry.name), **line)
    if max(found["values"]) > WIDEST_LINEAR_SPAN * min(found["values"]):
        ax.set_xscale("log")
    ax.set_xlabel(f"{found['name']} [{found['unit']}]")
    caption(ax, "$J_a$")
    legend_below(figure, [ax])
    return figure


def _spread(ax: Axes, curves: list[list[float]], *, color: str, label: str) -> None:
    """Draw the mean and range over the seeds, up to the last episode that all seeds have reached."""
    length = min(map(len, curves))
    values = np.array([curve[:length] for curve in curves])
    episode = np.arange(1, length + 1)
    ax.plot(episode, values.mean(0), color=color, linewidth=1.8, label=label)
    ax.fill_between(episode, values.min(0), values.max(0), color=color, alpha=0.15, linewidth=0.0)


def _bars(ax: Axes, means: list[float]) -> None:
    for column, mean in enumerate(means, 1):
        ax.plot([column - 0.3, column + 0.3], [mean, mean], color="0.1", linewidth=2.0)


def _colours(entries: list[Entry]) -> dict[str, str]:
    """Colour of each arm, policy and yardstick."""
    others = list(dict.fromkeys(entry.name for entry in entries if entry.curves and entry.name not in ARMS))
    policies = {name: POLICIES[k % len(POLICIES)] for k, name in enumerate(others)}
    return {entry.name: (ARMS | policies).get(entry.name, REFERENCE) for entry in entries}
