"""The tank's coefficients over the state, for a closure in which they depend on it."""

from typing import cast

import torch
from matplotlib.figure import Figure

from rt_torchrl.envs.cryogenic_tank.commands import GREATEST_DROP
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.evaluation.closure_error import visited_features
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import (
    CLOSURE_LINES,
    REAL,
    TWIN,
    array,
    caption,
    closures,
    last_episode,
    legend_below,
    panels,
    veil,
)

LABELS = {
    "U_s": ("wall to fluid $U_s$ [W/(m² K)]", 1.0),
    "U_HX": ("heat exchanger $U_{HX}$ [W/(m² K)]", 1.0),
    "K_JT": ("valve $K_{JT}$ [GPa s²/kg²]", 1e-9),
}
CLOSURE_COLOURS = {"true": REAL, "twin": TWIN, "initial twin": "0.55"}


@torch.no_grad()
def coefficients(snapshot: Snapshot) -> Figure:
    """U_s, U_HX and K_JT over each feature of the closure, with the other features at their mean in the last episode.

    Curves are pale where the episode did not visit; the axes extend the visited range by half of it on both sides.
    """
    plant = cast(CryogenicTank, snapshot.plant)
    seen = visited_features(plant, snapshot.record)
    axes_of = (
        ("pressure [kPa]", 1e-3 * plant.set_point),
        ("liquid volume [m³]", plant.volume),
        ("wall-fluid difference [mK]", 1e3 * plant.superheat_unit),
        ("valve drop [kPa]", 1e-3 * GREATEST_DROP),
    )
    title = f"Coefficients, episode {last_episode(snapshot)}\nother features at their mean in the episode"
    figure, axes = panels(3, 4, title=title, size=(13.0, 8.0), sharex="col", sharey="row")
    for column, (label, unit) in enumerate(axes_of):
        low, high = seen[:, column].min(), seen[:, column].max()
        reach = 0.5 * (high - low).clamp(min=1e-6)
        points = seen.mean(0).repeat(121, 1)
        ends = (low - reach).item(), (high + reach).item()
        points[:, column] = torch.linspace(*ends, 121, dtype=seen.dtype, device=seen.device)
        x, inside = unit * points[:, column], (points[:, column] >= low) & (points[:, column] <= high)
        for name, closure in closures(snapshot).items():
            look = {"color": CLOSURE_COLOURS[name], "linestyle": CLOSURE_LINES[name], "linewidth": 1.8, "label": name}
            for ax, values, (_, factor) in zip(axes[:, column], closure(points).T, LABELS.values(), strict=True):
                ax.plot(array(x), factor * array(values), **look)
        for ax, (name, _) in zip(axes[:, column], LABELS.values(), strict=True):
            ax.set_yscale("log")
            veil(ax, array(x), array(inside))
            caption(ax, name if column == 0 else "")
        axes[-1, column].set_xlabel(label)
    legend_below(figure, [axes[0, 0]])
    return figure
