"""Figure of a simulated record beside the measured one, with its interval and its errors."""

import numpy as np
from matplotlib.figure import Figure

from rt_torchrl.figures.style import REAL, TWIN, array, caption, legend_below, panels, time_unit, with_unit
from rt_torchrl.fit.prediction import Prediction
from rt_torchrl.fit.record import SensorRecord


def simulated_and_measured(prediction: Prediction, record: SensorRecord, dt: float, *, title: str) -> Figure:
    """The first sensor over time, as measured and as simulated with the 95 % interval of a reading; the errors below.

    Args:
        prediction: the simulated record.
        record: the measured record.
        dt: control interval [s].
        title: title of the figure.
    """
    unit, length = time_unit(dt * len(record.actions))
    t = (record.start + dt * np.arange(len(record.readings))) / length
    figure, axes = panels(2, title=title, size=(9.0, 5.6), sharex=True, height_ratios=[2, 1])
    above, below = axes[:, 0]
    middle = array(prediction.readings[:, 0])
    half = 1.96 * array((prediction.deviation[:, 0] ** 2 + prediction.noise[0] ** 2).sqrt())
    above.fill_between(t, middle - half, middle + half, color=TWIN, alpha=0.25, linewidth=0, label="95 % interval")
    above.plot(t, array(record.readings[:, 0]), color=REAL, linewidth=1.2, label="measured")
    above.plot(t, middle, color=TWIN, linewidth=1.2, label="simulated")
    below.plot(t, array(prediction.errors[:, 0]), color=REAL, linewidth=0.9)
    caption(above, "level [V]", f"RMS error {with_unit(prediction.rms[0].item(), 'V')}")
    caption(below, "measured less simulated [V]")
    below.set_xlabel(f"time [{unit}]")
    legend_below(figure, [above])
    return figure
