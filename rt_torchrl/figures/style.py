"""The style of every figure: colours with one meaning each, bare panels with their label on top, a time axis.

The colours are those of Okabe and Ito (2008), which colour-blind readers can tell apart. Figures are made without
pyplot, so they need no backend and no display, and are freed with their last reference.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from torch import Tensor, nn

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal
from rt_torchrl.steps.config import Role

REAL, TWIN, REFERENCE, LARGE_SCALE = "#222222", "#D55E00", "#009E73", "#D55E00"
FILTERED, SAMPLES, LIMITS = "#56B4E9", "#56B4E9", "0.55"
ROLES: dict[Role, str] = {"model_based": "#0072B2", "model_free": "#E69F00"}

WIDE_RANGE = 5.0
"""Ratio of the greatest to the least value from which an axis is logarithmic."""
LIMIT_LINE: dict[str, Any] = {"color": LIMITS, "linestyle": (0, (5, 3)), "linewidth": 1.2}
REFERENCE_LINE: dict[str, Any] = {"color": REFERENCE, "linestyle": (0, (5, 2)), "linewidth": 1.5}
CLOSURE_LINES: dict[str, Any] = {"true": "-", "twin": (0, (5, 2)), "initial twin": (0, (1, 1.5))}
CLOSURE_COLOURS = {"true": REAL, "twin": TWIN, "initial twin": "0.55"}


def panels(
    rows: int, columns: int = 1, *, title: str, size: tuple[float, float], **layout: Any
) -> tuple[Figure, np.ndarray]:
    """A figure at 100 dpi and its axes, ``rows`` by ``columns``.

    Args:
        rows: number of rows of axes.
        columns: number of columns of axes.
        title: title of the figure.
        size: width and height of the figure [inch].
        layout: further arguments of ``Figure.subplots``.
    """
    figure = Figure(figsize=size, dpi=100, layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.07))
    figure.suptitle(title, fontsize=12)
    axes = figure.subplots(rows, columns, squeeze=False, **layout)
    for ax in axes.flat:
        ax.grid(True, color="0.9", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=9)
    return figure, axes


def grid(
    count: int, columns: int = 1, *, title: str, size: tuple[float, float], xlabel: str, **layout: Any
) -> tuple[Figure, list[Axes]]:
    """A figure with a number of panels over one abscissa, row by row, whose label stands below the last of each column.

    Args:
        count: number of panels; there are as many rows as they need, and the last one need not be full.
        columns: number of columns.
        title: title of the figure.
        size: width and height of the figure [inch].
        xlabel: label of the abscissa.
        layout: further arguments of ``Figure.subplots``.
    """
    figure, subplots = panels(-(-count // columns), columns, title=title, size=size, sharex=True, **layout)
    axes = subplots.flat[:count].tolist()
    for ax in subplots.flat[count:]:
        ax.remove()
    for ax in axes[max(0, count - columns) :]:
        ax.set_xlabel(xlabel)
        ax.tick_params(labelbottom=True)
    return figure, axes


def timeline(
    plant: Plant, intervals: int, count: int, columns: int = 1, **of_grid: Any
) -> tuple[Figure, list[Axes], np.ndarray]:
    """A :func:`grid` over control intervals in s, min or h, whichever reads best, and their ends, from 0 on."""
    unit, length = time_unit(plant.dt * intervals)
    time = plant.dt / length * np.arange(intervals + 1)
    figure, axes = grid(count, columns, xlabel=f"time [{unit}]", **of_grid)
    axes[0].set_xlim(0.0, time[-1])
    return figure, axes, time


def pixels(figure: Figure) -> np.ndarray:
    """The figure drawn once at 120 dpi: red, green and blue of each pixel, (height, width, 3) of ``uint8``."""
    figure.set_dpi(120)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_pixels(image: np.ndarray, path: Path) -> None:
    """Write what ``pixels`` gave as PNG, whole or not at all."""
    file = io.BytesIO()
    imsave(file, image, format="png", dpi=120)
    write_atomically(path, file.getvalue())


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG at 120 dpi, whole or not at all."""
    save_pixels(pixels(figure), path)


def caption(ax: Axes, label: str, note: str = "") -> None:
    """Write the label of a panel, with its unit, above the panel on the left, and a note above it on the right.

    There the label fits however low the panel is.
    """
    ax.set_title(label, loc="left", fontsize=9.5)
    ax.set_title(note, loc="right", fontsize=9, color="0.35")


def legend_above(ax: Axes) -> None:
    """Draw a legend above the panel on the right, clear of its curves."""
    entries = _entries([ax])
    place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.0, "borderpad": 0.1}
    ax.legend(list(entries.values()), list(entries), ncols=max(1, len(entries)), fontsize=9, frameon=False, **place)


def legend_below(figure: Figure, axes: Sequence[Axes]) -> None:
    """Draw one legend for all panels below them, in as many columns as fit the figure."""
    entries = _entries(axes)
    if not entries:
        return
    # A line's sample takes about five letters of 0.085 inch.
    width = 0.085 * (max(map(len, entries)) + 5)
    columns = max(1, min(len(entries), int(figure.get_figwidth() / width)))
    handles, labels = list(entries.values()), list(entries)
    figure.legend(handles, labels, fontsize=9.5, frameon=False, loc="outside lower center", ncols=columns)


def _entries(axes: Sequence[Axes]) -> dict[str, Artist]:
    """Artist of each label; a label that several artists share appears once."""
    entries: dict[str, Artist] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    return entries


def limits(ax: Axes, signal: Signal, scale: float = 1.0) -> None:
    """Draw the finite ends of a signal's range, times ``scale``, as dashed lines."""
    for bound in filter(np.isfinite, (signal.low, signal.high)):
        ax.axhline(bound * scale, label="limits", **LIMIT_LINE)


def logarithmic_if_wide(ax: Axes, least_range: float = WIDE_RANGE) -> None:
    """Make an axis logarithmic whose values are positive and lie far apart."""
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in ax.lines])
    values = values[np.isfinite(values)]
    if values.size and values.min() > 0.0 and values.max() >= least_range * values.min():
        ax.set_yscale("log")
        if values.max() < 1000.0 * values.min():
            # Plain numbers 1, 2 and 5 of each decade.
            ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            ax.yaxis.set_minor_formatter(NullFormatter())


def veil(ax: Axes, x: np.ndarray, visited: np.ndarray) -> None:
    """Make a panel pale at every x that was not visited, because no record has taught the twin its values there."""
    whole: dict[str, Any] = {"transform": ax.get_xaxis_transform(), "color": "white", "linewidth": 0}
    ax.fill_between(x, 0.0, 1.0, where=~visited, alpha=0.65, zorder=2.5, **whole)


def means_of_groups(group: int, *series: np.ndarray) -> list[np.ndarray]:
    """The mean of every ``group`` samples of each series; the last group may be smaller."""
    starts = np.arange(0, len(series[0]), group)
    counts = np.diff(np.append(starts, len(series[0])))
    return [np.add.reduceat(values, starts) / counts for values in series]


def draw_groups(
    ax: Axes, time: np.ndarray, values: np.ndarray, group: int, *, linewidth: float, label: str, record: str
) -> None:
    """Draw the record in groups of samples: the mean of each, which ``record`` names, and its range, ``label``."""
    starts, (middle, mean) = np.arange(0, len(values), group), means_of_groups(group, time, values)
    if group > 1:
        least, greatest = (extreme.reduceat(values, starts) for extreme in (np.minimum, np.maximum))
        ax.fill_between(middle, least, greatest, color=SAMPLES, alpha=0.45, linewidth=0, label=label)
    ax.plot(middle, mean, color=REAL, linewidth=linewidth, label=record)


def closure_look(name: str) -> dict[str, Any]:
    """The look of a closure's curve: ``true``, ``twin`` or ``initial twin``."""
    return {"color": CLOSURE_COLOURS[name], "linestyle": CLOSURE_LINES[name], "linewidth": 1.8, "label": name}


def time_unit(seconds: float) -> tuple[str, float]:
    """Unit in which a length of time reads best, and the length of that unit [s]."""
    return ("s", 1.0) if seconds <= 1500.0 else ("min", 60.0) if seconds <= 10_800.0 else ("h", 3600.0)


def with_unit(value: float, unit: str) -> str:
    """A number to two digits with its unit; a pure number has none."""
    # The number is rounded first, so that hundreds are not written as powers of ten.
    number = f"{float(f'{value:.2g}'):g}"
    return number if unit == "-" else f"{number} {unit}"


def array(tensor: Tensor) -> np.ndarray:
    """A tensor as an array that matplotlib can draw."""
    return tensor.detach().cpu().numpy()


def closures(snapshot: Snapshot) -> dict[str, nn.Module]:
    """The closure of each line of ``CLOSURE_LINES``; that of the plant stands for a true one that is not known."""
    true = snapshot.plant.closure if snapshot.true_closure is None else snapshot.true_closure
    return dict(zip(CLOSURE_LINES, (true, snapshot.closure, snapshot.initial_closure), strict=True))


def episode(snapshot: Snapshot) -> str:
    """What a title calls the record."""
    return snapshot.simulated or f"episode {len(snapshot.episodes)}"


def record_label(snapshot: Snapshot) -> str:
    """Label of the record's line."""
    return "twin, in flight" if snapshot.on_the_twin else "real"


def twin_label(snapshot: Snapshot) -> str:
    """Label of the twin's line; without a large scale the arm trains no twin."""
    return "twin" if snapshot.large_scale is not None else "twin, not trained in this arm"


def role_name(role: Role) -> str:
    """Name of a policy in a figure."""
    return role.replace("_", "-")
