"""What changed from episode to episode: costs, roles, computing time."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, MaxNLocator

from rt_torchrl.figures.style import REAL, ROLES, STEPS, TWIN, caption, legend_above, panels, role_name
from rt_torchrl.snapshot import Snapshot
from rt_torchrl.switching import Role

CONTROL = {
    "real_cost": {"color": REAL, "marker": "o", "label": "real system, live"},
    "J_a_model_based": {"color": ROLES["model_based"], "marker": "s", "label": "model-based, twin"},
    "J_a_model_free": {"color": ROLES["model_free"], "marker": "^", "label": "model-free, twin"},
}
IDENTIFICATION = {
    "J_p_before": {"color": "0.55", "marker": "v", "label": "before assimilation"},
    "J_p": {"color": TWIN, "marker": "o", "label": "after assimilation"},
}
EVENTS = {
    "swap": {"color": "0.35", "linewidth": 1.2, "linestyle": "-", "label": "swap"},
    "clone": {"color": "0.35", "linewidth": 1.4, "linestyle": ":", "label": "clone"},
}


def learning_curves(snapshot: Snapshot) -> Figure:
    """Over the episodes: the cost of control, real and of both policies on the twin; the twin's error; who was live.

    The bottom strip is the timeline, a row per policy, filled where it was live and pale where it was idle. Vertical
    lines are swaps and clones; they lie between the episodes because that is when they happen. A panel whose values
    an arm does not report is left out.
    """
    episodes = snapshot.episodes
    shown = [
        (name, curves)
        for name, curves in (("control cost $J_a$", CONTROL), ("identification cost $J_p$", IDENTIFICATION))
        if any(np.isfinite(_column(episodes, key)).any() for key in curves)
    ]
    heights = [2.6] * len(shown) + [0.9]
    figure, axes = panels(
        len(heights),
        title="Learning curves and live policy",
        size=(8.5, 1.1 + sum(heights)),
        sharex=True,
        height_ratios=heights,
    )
    for (name, curves), ax in zip(shown, axes.flat, strict=False):
        _draw_costs(ax, episodes, curves)
        legend_above(ax)
        _draw_events(ax, episodes)
        caption(ax, name)
    _draw_timeline(axes[-1, 0], episodes, snapshot.live)
    return figure


def seconds(snapshot: Snapshot) -> Figure:
    """Wall-clock time of every episode, stacked by step in the order in which the steps are made."""
    spent = [episode.get("seconds") or {} for episode in snapshot.episodes]
    steps = list(dict.fromkeys(step for episode in spent for step in episode))
    figure, ((ax,),) = panels(1, title="Computing time per episode", size=(8.5, 4.2))
    number, base = np.arange(len(spent)), np.zeros(len(spent))
    for step in steps:
        height = np.array([float(episode.get(step, 0.0)) for episode in spent])
        ax.bar(number, height, bottom=base, width=0.8, color=STEPS.get(step, "#F0E442"), label=step.replace("_", " "))
        base += height
    caption(ax, "wall-clock time [s]")
    ax.set_xlabel("episode")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlim(-0.5, len(spent) - 0.5)
    # Reversed, so that the legend is stacked as the bars are.
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles[::-1], labels[::-1], loc="outside right upper", fontsize=9.5, frameon=False)
    return figure


def _column(episodes: list[dict[str, Any]], key: str) -> np.ndarray:
    """A value per episode; nan where the arm has none."""
    values = (episode.get(key) for episode in episodes)
    return np.array([np.nan if value is None else float(value) for value in values])


def _draw_costs(ax: Axes, episodes: list[dict[str, Any]], curves: dict[str, dict[str, str]]) -> None:
    number = np.arange(len(episodes))
    columns = {key: _column(episodes, key) for key in curves}
    columns = {key: column for key, column in columns.items() if np.isfinite(column).any()}
    for key, column in columns.items():
        ax.plot(number, column, linewidth=1.4, markersize=4, **curves[key])
    # A plant may have costs that are not positive, which a logarithm would hide.
    if all((column[np.isfinite(column)] > 0).all() for column in columns.values()):
        ax.set_yscale("log")
        # A decade or so needs numbers between the powers of ten.
        ax.yaxis.set_minor_formatter(LogFormatterSciNotation(minor_thresholds=(2, 0.4)))
        ax.grid(True, which="minor", axis="y", color="0.95", linewidth=0.5)
        ax.tick_params(which="minor", labelsize=8)


def _draw_events(ax: Axes, episodes: list[dict[str, Any]]) -> None:
    drawn = set()
    for number, episode in enumerate(episodes):
        event = episode.get("event")
        if event in EVENTS:
            line = ax.axvline(number + 0.5, zorder=1, **EVENTS[event])
            line.set_label(f"_{event}" if event in drawn else event)
            drawn.add(event)


def _draw_timeline(ax: Axes, episodes: list[dict[str, Any]], live: Role) -> None:
    """A row per policy: filled in the episodes in which it was live, pale in the others."""
    acted = [episode.get("live") or live for episode in episodes]
    for row, role in enumerate(reversed(ROLES)):
        for is_live, alpha in ((True, 1.0), (False, 0.15)):
            spans = [(k - 0.5, 1.0) for k, actor in enumerate(acted) if (actor == role) == is_live]
            ax.broken_barh(spans, (row - 0.4, 0.8), facecolors=ROLES[role], alpha=alpha, linewidth=0)
    _draw_events(ax, episodes)
    ax.set_yticks(range(len(ROLES)), [role_name(role) for role in reversed(ROLES)])
    ax.set_ylim(-0.55, len(ROLES) - 0.45)
    ax.grid(False)
    caption(ax, "live (filled) and idle (pale)")
    legend_above(ax)
    ax.set_xlabel("episode")
    ax.set_xlim(-0.5, len(episodes) - 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
