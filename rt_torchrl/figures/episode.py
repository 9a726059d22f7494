"""Figures of the last real episode: its states beside the twin's, its actions and its exogenous input."""

import numpy as np
from matplotlib.figure import Figure

from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import (
    LARGE_SCALE,
    REAL,
    ROLES,
    SAMPLES,
    TWIN,
    array,
    caption,
    last_episode,
    legend_below,
    limits,
    panels,
    role_name,
    time_axis,
    twin_label,
    with_unit,
)
from rt_torchrl.steps.config import Role


def states(snapshot: Snapshot) -> Figure:
    """Every state over time, as measured and as the twin replays it with the same actions, and the RMS difference."""
    signals, real, twin = snapshot.plant.states, array(snapshot.record.states), array(snapshot.replay)
    time, label = time_axis(snapshot.plant, len(real))
    columns = 1 if len(signals) <= 3 else 2
    rows = -(-len(signals) // columns)
    figure, axes = panels(
        rows,
        columns,
        title=f"Real and twin states, episode {last_episode(snapshot)}",
        size=(7.5 + 3.5 * (columns - 1), 1.0 + 1.9 * rows),
        sharex=True,
    )
    for k, (ax, signal) in enumerate(zip(axes.flat, signals, strict=False)):
        ax.plot(time, real[:, k], color=REAL, linewidth=1.9, label="real")
        ax.plot(time, twin[:, k], color=TWIN, linewidth=0.9, label=twin_label(snapshot))
        rms = np.sqrt(np.mean((twin[:, k] - real[:, k]) ** 2))
        rms = rms if rms > 1e-10 * np.abs(real[:, k]).max() else 0.0
        caption(ax, signal.label, f"RMS {with_unit(rms, signal.unit)}")
    for ax in axes.flat[len(signals) :]:
        ax.remove()
    # The last panel of a column, which need not be in the last row, has the label of the time axis.
    for ax in axes.flat[len(signals) - columns : len(signals)]:
        ax.set_xlabel(label)
        ax.tick_params(labelbottom=True)
    axes.flat[0].set_xlim(time[0], time[-1])
    legend_below(figure, [axes.flat[0]])
    return figure


def actions(snapshot: Snapshot) -> Figure:
    """Every applied action over time, held over each interval, with its limits."""
    signals, applied = snapshot.plant.actions, array(snapshot.record.actions)
    time, label = time_axis(snapshot.plant, len(applied))
    actor = _actor(snapshot)
    figure, axes = panels(
        len(signals),
        title=f"Applied actions, episode {last_episode(snapshot)}",
        size=(7.5, 1.2 + 2.0 * len(signals)),
        sharex=True,
    )
    for k, (ax, signal) in enumerate(zip(axes.flat, signals, strict=True)):
        ax.step(time, applied[:, k], where="post", color=ROLES[actor], linewidth=1.3, label=f"{role_name(actor)}, live")
        limits(ax, signal)
        caption(ax, signal.label)
    axes[-1, 0].set_xlabel(label)
    axes[-1, 0].set_xlim(0.0, time[-1] + time[1])
    legend_below(figure, tuple(axes.flat))
    return figure


def exogenous(snapshot: Snapshot) -> Figure:
    """Each input that acts on the plant as recorded, with its large scale, and below it samples of other possible ones.

    Each input has a column. In an arm that trains no twin the figure shows the record alone.
    """
    signals, recorded = snapshot.plant.acting_inputs, array(snapshot.record.exogenous)
    time, label = time_axis(snapshot.plant, len(recorded))
    rows = 1 if snapshot.large_scale is None else 2
    figure, axes = panels(
        rows,
        len(signals),
        title=f"Exogenous input, episode {last_episode(snapshot)}",
        size=(max(7.5, 5.0 * len(signals)), 0.9 + 2.4 * rows),
        sharex=True,
        sharey="col",
    )
    for k, signal in enumerate(signals):
        axes[0, k].plot(time, recorded[:, k], color=REAL, linewidth=1.0, label="recorded")
        if snapshot.large_scale is not None and snapshot.realisations is not None:
            samples, mean = array(snapshot.realisations), array(snapshot.large_scale)
            for sample in samples[:3]:
                axes[1, k].plot(time, sample[:, k], color=SAMPLES, linewidth=0.8, label="_")
            axes[1, k].lines[0].set_label(f"{len(samples[:3])} samples")
            for ax in axes[:, k]:
                ax.plot(time, mean[:, k], color=LARGE_SCALE, linewidth=2.2, label="large scale (SVR)")
        for ax in axes[:, k]:
            caption(ax, signal.label)
        axes[-1, k].set_xlabel(label)
        axes[-1, k].set_xlim(0.0, time[-1] + time[1])
    legend_below(figure, tuple(axes[:, 0]))
    return figure


def _actor(snapshot: Snapshot) -> Role:
    """Role that acted in the record; the snapshot's live policy may have changed since then."""
    return (snapshot.episodes[-1].get("live") if snapshot.episodes else None) or snapshot.live
