"""Figures of an identification from sensors: readings and replays, correlations, ellipses, intervals of a curve."""

import numpy as np
from matplotlib.figure import Figure

from rt_torchrl.figures.style import (
    LIMITS,
    REAL,
    SAMPLES,
    TWIN,
    array,
    caption,
    legend_below,
    panels,
    time_unit,
    with_unit,
)
from rt_torchrl.fit.least_squares import Estimate, Identified, Judgement
from rt_torchrl.fit.uncertainty import Band, Uncertainty


def twin_and_sensors(found: Identified) -> Figure:
    """What every sensor has read over time, and what the twin says it reads, after the estimation; held out is shaded.

    The notes give the root mean square errors on the held-out records.
    """
    sensors, dt = found.estimate.likelihood.sensors, found.estimate.likelihood.plant.dt
    training, held_out = found.training[1].records, found.held_out[1].records
    begin, last = training[0].start, held_out[-1].start
    unit, length = time_unit(last + dt * len(held_out[-1].actions) - begin)
    size = (9.0, 1.2 + 2.2 * len(sensors))
    figure, axes = panels(len(sensors), title="Twin and sensors", size=size, sharex=True)
    parts = ((training, found.training[1]), (held_out, found.held_out[1]))
    for k, (ax, sensor) in enumerate(zip(axes.flat, sensors, strict=True)):
        read = np.concatenate([array(record.readings[:, k]) for record in (*training, *held_out)])
        margin = 0.1 * (np.nanmax(read) - np.nanmin(read)) or 1.0
        for records, judgement in parts:
            for record, replayed in zip(records, judgement.readings, strict=True):
                t = (record.start + dt * np.arange(len(record.readings))) / length
                ax.plot(t, array(record.readings[:, k]), ".", color=REAL, markersize=2.5, label="read")
                ax.plot(t, array(replayed[:, k]), color=TWIN, linewidth=1.3, label="twin")
        for record in held_out:
            ends = record.start, record.start + dt * len(record.actions)
            ax.axvspan(*(t / length for t in ends), color="0.93", zorder=0, label="held out")
        # A twin that is far off must not flatten what was read.
        ax.set_ylim(np.nanmin(read) - margin, np.nanmax(read) + margin)
        before, after = (_rms(judged, k, sensor.measurement.unit) for judged in found.held_out)
        caption(ax, sensor.measurement.label, f"RMS held out {before} before, {after} after")
    axes.flat[-1].set_xlabel(f"time [{unit}]")
    legend_below(figure, list(axes.flat))
    return figure


def _rms(judged: Judgement, k: int, unit: str) -> str:
    return with_unit(judged.rms[k].item(), unit)


def weights(estimate: Estimate) -> Figure:
    """Every weight before and after, divided by its size after, with a bar of two standard errors.

    A weight of which the records say nothing has no bar.
    """
    names = list(estimate.after)
    figure, ((ax,),) = panels(1, title="Weights", size=(max(5.0, 1.5 + 0.8 * len(names)), 4.2))
    before, after = (np.array(list(values.values())) for values in (estimate.before, estimate.after))
    errors = np.array(list(estimate.uncertainty.standard_errors().values()))
    errors = np.where(np.isfinite(errors), errors, np.nan)
    unit, place = np.where(after == 0.0, 1.0, np.abs(after)), np.arange(len(names))
    ax.plot(place, before / unit, "o", color=LIMITS, markersize=5, label="before")
    bar = {"fmt": "o", "color": TWIN, "markersize": 5, "capsize": 4}
    ax.errorbar(place, after / unit, 2.0 * errors / unit, label="after, two standard errors", **bar)
    ax.set_xticks(place, names, rotation=0 if len(names) < 6 else 60)
    caption(ax, "weight over its size after [-]")
    legend_below(figure, [ax])
    return figure


def correlations(uncertainty: Uncertainty) -> Figure:
    """The correlations of a closure's values as numbers on colours; those that the data cannot tell are left out."""
    names, R = uncertainty.names, array(uncertainty.correlations())
    side = 1.8 + 0.55 * len(names)
    figure, axes = panels(1, title="Correlations of the weights", size=(side, side))
    ax = axes[0, 0]
    ax.grid(False)
    ax.imshow(R, vmin=-1.0, vmax=1.0, cmap="RdBu_r")
    for (i, j), value in np.ndenumerate(R):
        if np.isfinite(value):
            ax.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=7.5)
    ax.set_xticks(range(len(names)), names, rotation=60, ha="right")
    ax.set_yticks(range(len(names)), names)
    return figure


def curve(band: Band, *, xlabel: str, ylabel: str, data: np.ndarray, true: np.ndarray | None = None) -> Figure:
    """A learned curve with its pointwise interval, where data was, and the true curve if it is known.

    Args:
        band: the curve and its interval.
        xlabel, ylabel: labels of the axes.
        data: values of the abscissa that the records visited.
        true: the true curve at the band's abscissae.
    """
    figure, axes = panels(1, title="Learned curve and where data was", size=(7.0, 4.4))
    ax, x = axes[0, 0], array(band.x)
    ax.fill_between(x, array(band.low), array(band.high), color=TWIN, alpha=0.25, linewidth=0, label="95 % interval")
    ax.plot(x, array(band.middle), color=TWIN, label="twin")
    if true is not None:
        ax.plot(x, true, color=REAL, linestyle="--", label="true")
    below = ax.get_xaxis_transform()
    ax.plot(data, np.full(len(data), 0.02), "|", color=SAMPLES, transform=below, alpha=0.5, label="data")
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    legend_below(figure, [ax])
    return figure
