"""Figures of a training that any plant has: its last real episode, and its costs and weights over the episodes."""

import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, MaxNLocator, StrMethodFormatter

from rt_torchrl.figures import style
from rt_torchrl.figures.policy import policy_contours
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import REAL, ROLES, TWIN, array, caption, legend_above, legend_below
from rt_torchrl.plants.closures import described_weights, named_weights
from rt_torchrl.steps.config import Role

CONTROL: dict[str, dict[str, Any]] = {
    "real_cost": {"color": REAL, "marker": "o", "label": "real system, live"},
    "J_a_unseen": {"color": REAL, "marker": "*", "linestyle": ":", "label": "live, unseen"},
    "J_a_unseen_on_the_twin": {"color": TWIN, "marker": "*", "linestyle": ":", "label": "live, unseen, twin"},
    "J_a_model_based": {"color": ROLES["model_based"], "marker": "s", "label": "model-based, twin"},
    "J_a_model_free": {"color": ROLES["model_free"], "marker": "^", "label": "model-free, twin"},
}
IDENTIFICATION: dict[str, dict[str, Any]] = {
    "J_p_before": {"color": "0.55", "marker": "v", "label": "before assimilation"},
    "J_p": {"color": TWIN, "marker": "o", "label": "after assimilation"},
}
EVENTS: dict[str, dict[str, Any]] = {
    "swap": {"color": "0.35", "linewidth": 1.2, "linestyle": "-", "label": "swap"},
    "clone": {"color": "0.35", "linewidth": 1.4, "linestyle": ":", "label": "clone"},
}
WIDE_RANGE = 5.0
"""Ratio of a weight's greatest to its least value from which its axis is logarithmic."""


def figures_of(snapshot: Snapshot) -> dict[str, Figure]:
    """The figures of a training by name; a figure with nothing to show is left out.

    ``exogenous`` needs an arm that trains a twin, and a plant with inputs. ``closure_weights`` needs an arm that trains
    a twin, and episodes that report coefficients by name. ``learning_curves`` needs a reported episode, and
    ``seconds`` an episode that reports them.
    """
    twin = snapshot.large_scale is not None
    chosen = [states, actions, policy_contours]
    chosen += [exogenous] if twin and snapshot.plant.inputs else []
    chosen += [closure_weights] if twin and tracked_weights(snapshot.episodes) else []
    chosen += [learning_curves] if snapshot.episodes else []
    chosen += [seconds] if any(episode.get("seconds") for episode in snapshot.episodes) else []
    return {figure.__name__: figure(snapshot) for figure in chosen}


def states(snapshot: Snapshot) -> Figure:
    """Every state over time, as measured and as the twin replays it with the same actions, and the RMS difference."""
    signals, real, twin = snapshot.plant.states, array(snapshot.record.states), array(snapshot.replay)
    columns = 1 if len(signals) <= 3 else 2
    figure, axes, time = style.timeline(
        snapshot.plant,
        len(real) - 1,
        len(signals),
        columns,
        title=f"Real and twin states, episode {style.last_episode(snapshot)}",
        size=(7.5 + 3.5 * (columns - 1), 1.0 + 1.9 * -(-len(signals) // columns)),
    )
    for k, (ax, signal) in enumerate(zip(axes, signals, strict=True)):
        ax.plot(time, real[:, k], color=REAL, linewidth=1.9, label="real")
        ax.plot(time, twin[:, k], color=TWIN, linewidth=0.9, label=style.twin_label(snapshot))
        rms = np.sqrt(np.mean((twin[:, k] - real[:, k]) ** 2))
        rms = rms if rms > 1e-10 * np.abs(real[:, k]).max() else 0.0
        caption(ax, signal.label, f"RMS {style.with_unit(rms, signal.unit)}")
    legend_below(figure, axes[:1])
    return figure


def actions(snapshot: Snapshot) -> Figure:
    """Every applied action over time, held over each interval, with its limits."""
    signals, applied = snapshot.plant.actions, array(snapshot.record.actions)
    # Who acted in the record; the snapshot's live policy may have changed since then.
    actor = (snapshot.episodes[-1].get("live") if snapshot.episodes else None) or snapshot.live
    title, size = f"Applied actions, episode {style.last_episode(snapshot)}", (7.5, 1.2 + 2.0 * len(signals))
    figure, axes, time = style.timeline(snapshot.plant, len(applied), len(signals), title=title, size=size)
    look: dict[str, Any] = {"color": ROLES[actor], "linewidth": 1.3, "label": f"{style.role_name(actor)}, live"}
    for k, (ax, signal) in enumerate(zip(axes, signals, strict=True)):
        ax.step(time[:-1], applied[:, k], where="post", **look)
        style.limits(ax, signal)
        caption(ax, signal.label)
    legend_below(figure, axes)
    return figure


def exogenous(snapshot: Snapshot) -> Figure:
    """Each input that acts on the plant as recorded, with its large scale, and below it samples of other possible ones.

    Each input has a column. In an arm that trains no twin the figure shows the record alone.
    """
    signals, recorded = snapshot.plant.acting_inputs, array(snapshot.record.exogenous)
    columns, rows = len(signals), 1 if snapshot.large_scale is None else 2
    figure, axes, time = style.timeline(
        snapshot.plant,
        len(recorded),
        rows * columns,
        columns,
        title=f"Exogenous input, episode {style.last_episode(snapshot)}",
        size=(max(7.5, 5.0 * columns), 0.9 + 2.4 * rows),
        sharey="col",
    )
    time = time[:-1]
    for k, signal in enumerate(signals):
        above, *below = axes[k::columns]
        above.plot(time, recorded[:, k], color=REAL, linewidth=1.0, label="recorded")
        if snapshot.large_scale is not None and snapshot.realisations is not None:
            samples, mean = array(snapshot.realisations[:3]), array(snapshot.large_scale)
            for sample in samples:
                below[0].plot(time, sample[:, k], color=style.SAMPLES, linewidth=0.8, label="_")
            below[0].lines[0].set_label(f"{len(samples)} samples")
            for ax in (above, *below):
                ax.plot(time, mean[:, k], color=style.LARGE_SCALE, linewidth=2.2, label="large scale (SVR)")
        for ax in (above, *below):
            caption(ax, signal.label)
    legend_below(figure, axes[::columns])
    return figure


def learning_curves(snapshot: Snapshot) -> Figure:
    """Costs of control on the real system and on the twin, the twin's error, and the live policy, over the episodes.

    The strip at the bottom has a row for each policy, which is filled where the policy was live and pale where it was
    idle. Vertical lines are swaps and clones; they lie between the episodes because they happen there. A panel is left
    out if the arm does not report its values.
    """
    episodes = snapshot.episodes
    shown = [
        (name, curves)
        for name, curves in (("control cost $J_a$", CONTROL), ("identification cost $J_p$", IDENTIFICATION))
        if any(np.isfinite(_column(episodes, key)).any() for key in curves)
    ]
    heights = [2.6] * len(shown) + [0.9]
    figure, (*axes, strip) = style.grid(
        len(heights),
        title="Learning curves and live policy",
        size=(8.5, 1.1 + sum(heights)),
        xlabel="episode",
        height_ratios=heights,
    )
    for (name, curves), ax in zip(shown, axes, strict=True):
        for key, look in curves.items():
            if np.isfinite(column := _column(episodes, key)).any():
                ax.plot(np.arange(len(episodes)), column, linewidth=1.4, markersize=4, **look)
        _logarithmic(ax)
        legend_above(ax)
        _draw_events(ax, episodes)
        caption(ax, name)
    _draw_timeline(strip, episodes, snapshot.live)
    return figure


def seconds(snapshot: Snapshot) -> Figure:
    """Wall-clock time of every episode, stacked by step in the order of the steps."""
    spent = [episode.get("seconds") or {} for episode in snapshot.episodes]
    steps = list(dict.fromkeys(step for episode in spent for step in episode))
    figure, (ax,) = style.grid(1, title="Computing time per episode", size=(8.5, 4.2), xlabel="episode")
    number, base = np.arange(len(spent)), np.zeros(len(spent))
    for step in steps:
        height = np.array([float(episode.get(step, 0.0)) for episode in spent])
        ax.bar(
            number, height, bottom=base, width=0.8, color=style.STEPS.get(step, "#F0E442"), label=step.replace("_", " ")
        )
        base += height
    caption(ax, "wall-clock time [s]")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlim(-0.5, len(spent) - 0.5)
    # The legend is reversed, so that its entries have the order of the stacked bars.
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles[::-1], labels[::-1], loc="outside right upper", fontsize=9.5, frameon=False)
    return figure


@torch.no_grad()
def closure_weights(snapshot: Snapshot, labels: Mapping[str, tuple[str, float]] | None = None) -> Figure:
    """Each named coefficient of the twin after every episode, with its initial and, if it is known, its true value.

    The number above a panel is the relative difference between the last value and the true one.

    Args:
        snapshot: snapshot whose episodes report ``closure``, see :func:`tracked_weights`.
        labels: label with unit, and factor from the coefficient to that unit, by the coefficient's name; by default the
            label is the name with the unit and the meaning that the closure states.
    """
    columns = tracked_weights(snapshot.episodes)
    true, start = (_numbers(named_weights(c)) for c in (snapshot.plant.closure, snapshot.initial_closure))
    true = true if snapshot.known else {}
    described = described_weights(snapshot.initial_closure)
    wide = min(3, len(columns))
    size = (0.6 + 3.6 * wide, 1.3 + 2.8 * -(-len(columns) // wide))
    title = "Closure weights of the twin over the episodes"
    figure, axes = style.grid(len(columns), wide, title=title, size=size, xlabel="episode")
    for ax, (name, found) in zip(axes, columns.items(), strict=True):
        label, factor = (labels or {}).get(name, (_label(name, described.get(name, {})), 1.0))
        ax.plot(np.arange(len(found)), factor * found, "o-", color=TWIN, linewidth=1.4, markersize=4, label="twin")
        if name in start:
            ax.axhline(factor * start[name], color="0.55", linestyle=(0, (1, 1.5)), linewidth=1.5, label="start")
        if name in true:
            ax.axhline(factor * true[name], label="true", **style.REFERENCE_LINE)
        if _logarithmic(ax, WIDE_RANGE):
            style.plain_numbers(ax)
        caption(ax, label, f"{100.0 * (found[-1] / true[name] - 1.0):+.2g} %" if true.get(name) else "")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes[0].set_xlim(-0.5, len(snapshot.episodes) - 0.5)
    legend_below(figure, axes)
    return figure


def _label(name: str, about: Mapping[str, str]) -> str:
    """The label of a panel: the name of a weight, with its unit if there is one, and below it what it means."""
    unit, meaning = about.get("unit"), about.get("meaning", "")
    words = name.replace("_", " ") + ("" if unit in (None, "-") else f" [{unit}]")
    return "\n".join([words, *textwrap.wrap(meaning, 44)])


def tracked_weights(episodes: list[dict[str, Any]]) -> dict[str, Float[np.ndarray, " episodes"]]:
    """Coefficients that episodes report as a number with a name; nan in an episode that does not report them.

    There are none in runs that are older than the key ``closure``, nor for a closure whose weights have no names.
    """
    reported = [_numbers(episode.get("closure")) for episode in episodes]
    return {name: _column(reported, name) for name in dict.fromkeys(name for found in reported for name in found)}


def _numbers(closure: dict[str, Any] | None) -> dict[str, float]:
    """Weights from :func:`named_weights` that are numbers with a name."""
    return {name: value for name, value in (closure or {}).items() if isinstance(value, float)}


def _column(episodes: list[dict[str, Any]], key: str) -> np.ndarray:
    """One value per episode; nan in an episode that does not report it."""
    values = (episode.get(key) for episode in episodes)
    return np.array([np.nan if value is None else float(value) for value in values])


def _logarithmic(ax: Axes, least_range: float = 1.0) -> bool:
    """Make the axis logarithmic, unless it would hide a value that is not positive, or all values are close together.

    Args:
        ax: axis with its lines.
        least_range: ratio of the greatest to the least value from which the axis becomes logarithmic.

    Returns:
        Whether the axis is logarithmic.
    """
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in ax.lines])
    values = values[np.isfinite(values)]
    if values.size == 0 or values.min() <= 0.0 or values.max() < least_range * values.min():
        return False
    ax.set_yscale("log")
    if values.max() < 10.0 * values.min():
        # Within a decade 4, 5, 6 read better than multiples of a power of ten.
        for set_formatter in (ax.yaxis.set_major_formatter, ax.yaxis.set_minor_formatter):
            set_formatter(StrMethodFormatter("{x:g}"))
    else:
        # An axis of about a decade needs numbers between the powers of ten.
        ax.yaxis.set_minor_formatter(LogFormatterSciNotation(minor_thresholds=(2, 0.4)))
    ax.grid(True, which="minor", axis="y", color="0.95", linewidth=0.5)
    ax.tick_params(which="minor", labelsize=8)
    return True


def _draw_events(ax: Axes, episodes: list[dict[str, Any]]) -> None:
    drawn = set()
    for number, episode in enumerate(episodes):
        event = episode.get("event")
        if event in EVENTS:
            line = ax.axvline(number + 0.5, zorder=1, **EVENTS[event])
            line.set_label(f"_{event}" if event in drawn else event)
            drawn.add(event)


def _draw_timeline(ax: Axes, episodes: list[dict[str, Any]], live: Role) -> None:
    """Draw a row for each policy, filled in the episodes in which it was live and pale in the others."""
    acted = [episode.get("live") or live for episode in episodes]
    for row, role in enumerate(reversed(ROLES)):
        for is_live, alpha in ((True, 1.0), (False, 0.15)):
            spans = [(k - 0.5, 1.0) for k, actor in enumerate(acted) if (actor == role) == is_live]
            ax.broken_barh(spans, (row - 0.4, 0.8), facecolors=ROLES[role], alpha=alpha, linewidth=0)
    _draw_events(ax, episodes)
    ax.set_yticks(range(len(ROLES)), [style.role_name(role) for role in reversed(ROLES)])
    ax.set_ylim(-0.55, len(ROLES) - 0.45)
    ax.grid(False)
    caption(ax, "live (filled) and idle (pale)")
    legend_above(ax)
    # An event at the end of the last episode would otherwise lie on the frame.
    room = 0.25 if episodes[-1].get("event") in EVENTS else 0.0
    ax.set_xlim(-0.5, len(episodes) - 0.5 + room)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
