"""Figures of an identification: the twin beside the log, and the weights with their standard errors."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rt_torchrl.figures.style import LIMITS, REAL, TWIN, array, caption, legend_below, panels, time_unit, with_unit
from rt_torchrl.fit.identification import Identified, Judgement
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Trajectory


def twin_and_log(
    plant: Plant,
    shown: Sequence[int],
    training: Sequence[Trajectory],
    held_out: Sequence[Trajectory],
    found: Identified,
) -> Figure:
    """Every logged state over time, as logged and as the twin replays it before and after; held-out time is shaded.

    The notes give the root mean square errors on the held-out segments.
    """
    begin, last = float(training[0].start), float(held_out[-1].start)
    unit, length = time_unit(last + plant.dt * len(held_out[-1].actions) - begin)
    figure, axes = panels(len(shown), title="Twin and log", size=(9.0, 1.2 + 2.2 * len(shown)), sharex=True)
    for ax, k in zip(axes.flat, shown, strict=True):
        parts = ((training, found.training), (held_out, found.held_out))
        for segments, (before, after) in parts:
            _draw(ax, plant, k, segments, before, after, length)
        for segment in held_out:
            ends = segment.start, segment.start + plant.dt * len(segment.actions)
            ax.axvspan(*(t / length for t in ends), color="0.93", zorder=0, label="held out")
        log = np.concatenate([array(s.states[:, k]) for s in (*training, *held_out)])
        margin = 0.1 * np.ptp(log) or 1.0
        # A twin that is far off before the identification must not flatten the other curves.
        ax.set_ylim(log.min() - margin, log.max() + margin)
        signal = plant.states[k]
        rms = [with_unit(judged.rms[k].item(), signal.unit) for judged in found.held_out]
        caption(ax, signal.label, f"RMS held out {rms[0]} before, {rms[1]} after")
    axes[-1, 0].set_xlabel(f"time [{unit}]")
    legend_below(figure, [axes.flat[0]])
    return figure


def weights(found: Identified) -> Figure:
    """Every weight before and after, divided by its size after, with a bar of two standard errors.

    A weight of which the segments say nothing has no bar.
    """
    names = list(found.weights)
    figure, ((ax,),) = panels(1, title="Weights", size=(max(5.0, 1.5 + 0.8 * len(names)), 4.2))
    after = np.array([entry["after"] for entry in found.weights.values()])
    unit = np.where(after == 0.0, 1.0, np.abs(after))
    before = np.array([entry["before"] for entry in found.weights.values()])
    errors = np.array([entry["standard_error"] for entry in found.weights.values()])
    errors = np.where(np.isfinite(errors), errors, np.nan)
    place = np.arange(len(names))
    ax.plot(place, before / unit, "o", color=LIMITS, markersize=5, label="before")
    bar = {"fmt": "o", "color": TWIN, "markersize": 5, "capsize": 4}
    ax.errorbar(place, after / unit, 2.0 * errors / unit, label="after, two standard errors", **bar)
    ax.set_xticks(place, names, rotation=0 if len(names) < 6 else 60)
    caption(ax, "weight over its size after [-]")
    legend_below(figure, [ax])
    return figure


def _draw(
    ax: Axes,
    plant: Plant,
    k: int,
    segments: Sequence[Trajectory],
    before: Judgement,
    after: Judgement,
    length: float,
) -> None:
    for segment, first, last in zip(segments, before.states, after.states, strict=True):
        time = (segment.start + plant.dt * np.arange(len(segment.states))) / length
        ax.plot(time, array(segment.states[:, k]), color=REAL, linewidth=1.4, label="log")
        ax.plot(time, array(first[:, k]), color=LIMITS, linewidth=1.0, linestyle=":", label="twin before")
        ax.plot(time, array(last[:, k]), color=TWIN, linewidth=1.0, label="twin after")
