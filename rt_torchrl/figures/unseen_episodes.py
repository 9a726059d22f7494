"""The figure of the controllers' results on episodes that they were never trained on."""

from typing import Any

import numpy as np
from jaxtyping import Bool
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from rt_torchrl.evaluation.unseen import Judged
from rt_torchrl.figures.style import REFERENCE, ROLES, array, caption, legend_below, panels

MARKERS = ("o", "^", "s", "D")
"""Marker of each kind of episodes."""
WIDEST_LINEAR = 30.0
"""Ratio of the greatest to the least value above which a panel is logarithmic."""


def unseen(judged: dict[str, Judged], categories: dict[str, Bool[Tensor, " count"]], *, where: str = "") -> Figure:
    """J_a and every quantity of the plant's merit by controller, a point for each episode and a bar at each mean.

    Args:
        judged: results of each controller by name, with the policies first.
        categories: episodes of each kind by name; each kind has its own marker.
        where: words of the title that say where the episodes were flown, such as "on the twin".
    """
    first = next(iter(judged.values()))
    quantities = {"$J_a$": {name: found.control_costs for name, found in judged.items()}}
    quantities |= {name: {who: found.merit[name] for who, found in judged.items()} for name in first.merit}
    count = len(first.control_costs)
    title = f"{count} unseen episodes{f' {where}' if where else ''}, a point each; bar: mean"
    figure, axes = panels(1, len(quantities), title=title, size=(max(4.5, 3.1 * len(quantities)), 4.2))
    kinds = {kind: array(chosen) for kind, chosen in categories.items()} or {"": np.ones(count, dtype=bool)}
    for ax, (name, values) in zip(axes.flat, quantities.items(), strict=True):
        _strip(ax, {who: array(found) for who, found in values.items()}, kinds)
        caption(ax, name)
    if categories:
        # The legend is grey, because the marker tells the kind and the colour tells the controller.
        for marker, kind in zip(MARKERS, kinds, strict=False):
            axes[0, 0].plot([], [], marker, color="0.4", markersize=6, markeredgewidth=0.0, label=kind)
        legend_below(figure, [axes[0, 0]])
    return figure


def _strip(ax: Axes, values: dict[str, np.ndarray], kinds: dict[str, np.ndarray]) -> None:
    """Draw a column of points for each controller, spread sideways so that they do not hide each other."""
    rng = np.random.default_rng(0)
    colours = {str(role): colour for role, colour in ROLES.items()}
    for column, (who, found) in enumerate(values.items()):
        place = column + 0.25 * rng.uniform(-1.0, 1.0, len(found))
        for marker, chosen in zip(MARKERS, kinds.values(), strict=False):
            style: dict[str, Any] = {"color": colours.get(who, REFERENCE), "alpha": 0.6, "markersize": 4.5}
            ax.plot(place[chosen], found[chosen], marker, markeredgewidth=0.0, **style)
        ax.plot([column - 0.35, column + 0.35], [found.mean()] * 2, color="0.1", linewidth=2.0)
    together = np.concatenate(list(values.values()))
    if together.min() > 0.0 and together.max() > WIDEST_LINEAR * together.min():
        ax.set_yscale("log")
    # Names take two lines, because four of them beside each other are wider than a panel.
    ax.set_xticks(range(len(values)), [who.replace("_", "-\n") for who in values])
    ax.set_xlim(-0.6, len(values) - 0.4)
