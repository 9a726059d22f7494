"""Figures of an identification from sensors: readings and replays, and the correlations of the weights."""

import numpy as np
from matplotlib.figure import Figure

from rt_torchrl.figures import style
from rt_torchrl.figures.style import REAL, TWIN, array, caption, legend_below, panels
from rt_torchrl.fit.least_squares import Identified
from rt_torchrl.fit.uncertainty import Uncertainty


def twin_and_sensors(identified: Identified) -> Figure:
    """What every sensor has read over time, and what the twin says it reads, after the estimation; held out is shaded.

    The notes give the root mean square errors on the held-out records.
    """
    sensors, dt = identified.estimate.likelihood.sensors, identified.estimate.likelihood.plant.dt
    training, held_out = identified.training.records, identified.held_out.records
    begin, last = training[0].start, held_out[-1].start
    unit, length = style.time_unit(last + dt * len(held_out[-1].actions) - begin)
    size = (9.0, 1.2 + 2.2 * len(sensors))
    figure, axes = style.grid(len(sensors), title="Twin and sensors", size=size, xlabel=f"time [{unit}]")
    parts = ((training, identified.training), (held_out, identified.held_out))
    for k, (ax, sensor) in enumerate(zip(axes, sensors, strict=True)):
        readings = np.concatenate([array(record.readings[:, k]) for record in (*training, *held_out)])
        margin = 0.1 * (np.nanmax(readings) - np.nanmin(readings)) or 1.0
        for records, judgement in parts:
            for record, replayed in zip(records, judgement.readings, strict=True):
                t = (record.start + dt * np.arange(len(record.readings))) / length
                ax.plot(t, array(record.readings[:, k]), ".", color=REAL, markersize=2.5, label="read")
                ax.plot(t, array(replayed[:, k]), color=TWIN, linewidth=1.3, label="twin")
        for record in held_out:
            ends = record.start, record.start + dt * len(record.actions)
            ax.axvspan(*(t / length for t in ends), color="0.93", zorder=0, label="held out")
        # A twin that is far off must not flatten what was read.
        ax.set_ylim(np.nanmin(readings) - margin, np.nanmax(readings) + margin)
        error = style.with_unit(identified.held_out.rms[k].item(), sensor.measurement.unit)
        caption(ax, sensor.measurement.label, f"RMS held out {error}")
    legend_below(figure, axes)
    return figure


def correlations(uncertainty: Uncertainty) -> Figure:
    """The correlations of a closure's values as numbers on colours; those that the data cannot tell are left out."""
    names, R = uncertainty.names, array(uncertainty.correlations())
    side = 1.8 + 0.55 * len(names)
    figure, ((ax,),) = panels(1, title="Correlations of the weights", size=(side, side))
    ax.grid(False)
    ax.imshow(R, vmin=-1.0, vmax=1.0, cmap="RdBu_r")
    for (i, j), value in np.ndenumerate(R):
        if np.isfinite(value):
            ax.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=7.5)
    ax.set_xticks(range(len(names)), names, rotation=60, ha="right")
    ax.set_yticks(range(len(names)), names)
    return figure
