"""Figures of a benchmark: time against the horizon and against the realisations."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from benchmarking.contenders import QUANTITIES
from benchmarking.timing import Cell
from rt_torchrl.figures.style import caption, legend_below, panels

COLOURS = {
    "native": "#D55E00",
    "parallel": "#0072B2",
    "odeint_adjoint": "#009E73",
    "autograd": "#222222",
    "jax_scan": "#E69F00",
    "jax_sweep": "#CC79A7",
    "casadi_scalar": "#56B4E9",
    "casadi_lanes": "#7F7F7F",
}
MARKERS = "osv^D*Pdhp"
AXES = {"steps": "control intervals", "realisations": "realisations"}


def save_figures(cells: Sequence[Cell], folder: Path) -> list[Path]:
    """Draw one figure for each case and number of threads, with time over horizons and over realisations.

    On one thread it is CPU time, which other processes on the machine change least; on more threads it is wall time.
    A size that does not vary has no panels.

    Args:
        cells: the cells; those that were left out are not drawn.
        folder: folder of the files.

    Returns:
        The paths of the files.
    """
    drawn = [cell for cell in cells if not cell.left_out]
    paths = []
    for case, threads in dict.fromkeys((cell.size.case, cell.size.threads) for cell in drawn):
        chosen = [cell for cell in drawn if (cell.size.case, cell.size.threads) == (case, threads)]
        plural = "thread" if threads == 1 else "threads"
        clock = "CPU" if threads == 1 else "wall"
        varied = [along for along in AXES if len({getattr(cell.size, along) for cell in chosen}) > 1] or ["steps"]
        title = f"{case.name}, {threads} {plural}\n{clock} time [s]"
        figure, axes = panels(len(varied), 2, title=title, size=(10.5, 4.0 * len(varied)), sharey="row")
        for row, along in zip(axes, varied, strict=True):
            for ax, quantity in zip(row, QUANTITIES, strict=True):
                of_quantity = [cell for cell in chosen if cell.quantity == quantity]
                _draw(ax, of_quantity, along, quantity, clock.lower())
        legend_below(figure, list(axes.flat))
        path = folder / f"{case.plant}-{case.closure}-{case.policy}-{threads}.png"
        figure.savefig(path)
        paths.append(path)
    return paths


def _draw(ax: Axes, cells: Sequence[Cell], along: str, quantity: str, clock: str) -> None:
    """Draw the line of each contender along one of the two sizes, at the value of the other with the most points."""
    across = next(other for other in AXES if other != along)
    values = [getattr(cell.size, across) for cell in cells]
    at = max(set(values), key=lambda value: (len(_different(cells, across, value, along)), value), default=0)
    names = list(dict.fromkeys(cell.contender for cell in cells))
    for k, name in enumerate(names):
        line = sorted(
            (getattr(cell.size, along), getattr(cell, clock))
            for cell in cells
            if cell.contender == name and getattr(cell.size, across) == at
        )
        if line:
            look: dict[str, Any] = {"color": COLOURS.get(name, f"C{k}"), "marker": MARKERS[k % len(MARKERS)]}
            ax.plot(*zip(*line, strict=True), label=name.replace("_", " "), markersize=5, **look)
    ax.set(xscale="log", yscale="log")
    ax.set_xlabel(AXES[along])
    caption(ax, quantity, f"{at} {AXES[across]}")


def _different(cells: Sequence[Cell], across: str, value: int, along: str) -> set[int]:
    return {getattr(cell.size, along) for cell in cells if getattr(cell.size, across) == value}
