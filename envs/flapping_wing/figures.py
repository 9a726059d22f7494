"""Figures of the flapping-wing drone: its flight, the polars of its wings, and its policies."""

from typing import Any, cast

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rt_torchrl.envs.flapping_wing.plant import ERRORS, FlappingWing
from rt_torchrl.evaluation.law import visited_features
from rt_torchrl.figures import style
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import REAL, REFERENCE_LINE, SAMPLES, TWIN, array, caption
from rt_torchrl.figures.training import contours

SPAN_SHARE = 0.7
"""Place of the angle of attack along the wing, from root 0 to tip 1; the outer wing makes most of the force."""
BIN = 5.0
"""Width of the histogram of visited angles [deg]."""


def figures_of(snapshot: Snapshot) -> dict[str, Figure]:
    """Every figure of the flapping wing, by name; the control surfaces only for policies that observe the errors."""
    observed = tuple(signal.name for signal in snapshot.plant.observations)
    of_errors = [control_surfaces] if observed[: len(ERRORS)] == ERRORS else []
    return {figure.__name__: figure(snapshot) for figure in (flight_path, flight, polars, *of_errors)}


def flight_path(snapshot: Snapshot) -> Figure:
    """The last flight in the vertical plane with a mark at each second.

    The axes span the real flight and the target; a twin that flies elsewhere leaves them.
    """
    plant, real, twin = cast(FlappingWing, snapshot.plant), array(snapshot.record.states), array(snapshot.replay)
    figure, ((ax,),) = style.panels(1, title=f"Flight path, {style.episode(snapshot)}", size=(7.0, 5.8))
    ax.plot(*real[:, :2].T, color=REAL, linewidth=1.9, label=style.record_label(snapshot))
    ax.plot(*real[0, :2], "s", color=REAL, markersize=7, label="start")
    ax.plot(*array(plant.target), "*", color=style.REFERENCE, markersize=15, label="target")
    # The line is added instead of plotted, so that the axes do not grow to hold it.
    ax.add_artist(Line2D(*twin[:, :2].T, color=TWIN, linewidth=1.0, label=style.twin_label(snapshot)))
    ax.margins(0.09)
    second = np.arange(round(1.0 / plant.dt), len(real), round(1.0 / plant.dt))
    ax.plot(*real[second, :2].T, "o", color=REAL, markersize=4.5, label="every second")
    ax.set_aspect("equal", adjustable="datalim")
    caption(ax, "vertical plane")
    ax.set_xlabel(plant.states[0].label)
    ax.set_ylabel(plant.states[1].label)
    style.legend_below(figure, [ax])
    return figure


def flight(snapshot: Snapshot) -> Figure:
    """Positions, speeds and actions over time (paper, fig. 17): along x on the left, along z on the right.

    The stroke plane angle stands under the horizontal motion that it drives, the amplitude under the vertical motion.
    Speeds shake with the wing beat, and actions answer them; the figure shows their mean and their range in each beat.
    """
    plant, real, twin = cast(FlappingWing, snapshot.plant), array(snapshot.record.states), array(snapshot.replay)
    applied = array(snapshot.record.actions)
    beat = round(1.0 / (plant.frequency * plant.dt))
    of_beats: dict[str, Any] = {
        "linewidth": 1.9,
        "label": "range within each beat",
        "record": style.record_label(snapshot),
    }
    title = f"Flight, {style.episode(snapshot)}\nspeeds and actions: mean over each wing beat"
    figure, axes, time = style.timeline(plant, len(applied), 6, 2, title=title, size=(11.0, 7.4))
    for k, ax in enumerate(axes[:2]):
        ax.plot(time, real[:, k], color=REAL, linewidth=1.9, label=style.record_label(snapshot))
        ax.plot(time, twin[:, k], color=TWIN, linewidth=0.9, label=style.twin_label(snapshot))
        ax.axhline(plant.target[k].item(), label="target", **REFERENCE_LINE)
        caption(ax, plant.states[k].label)
    for k, ax in enumerate(axes[2:4], 2):
        style.draw_groups(ax, time[:-1], real[:-1, k], beat, **of_beats)
        means = style.means_of_groups(beat, time[:-1], twin[:-1, k])
        ax.plot(*means, color=TWIN, linewidth=0.9, label=style.twin_label(snapshot))
        ax.axhline(0.0, label="target", **REFERENCE_LINE)
        caption(ax, plant.states[k].label)
    for k, ax in zip((1, 0), axes[4:], strict=True):
        style.draw_groups(ax, time[:-1], applied[:, k], beat, **of_beats)
        style.limits(ax, plant.actions[k])
        caption(ax, plant.actions[k].label)
    style.legend_below(figure, axes[::2])
    return figure


@torch.no_grad()
def polars(snapshot: Snapshot) -> Figure:
    """C_L and C_D of the true wing, the twin and the initial twin over the effective angle of attack.

    The lowest panel shows how often the last flight had each angle at 70 % of the span, because a twin can only know
    what was visited. Angles that no blade element had are pale.
    """
    plant = cast(FlappingWing, snapshot.plant)
    everywhere = visited_features(plant, plant.closure, plant.closure, snapshot.record)[0]  # (sin α_e, cos α_e)
    visited = everywhere[:, (plant.radius - plant.wing_root - SPAN_SHARE * plant.wing_length).abs().argmin()]
    C = {name: closure(visited) for name, closure in style.closures(snapshot).items()}
    rms = {name: array((C[name] - C["true"]).square().mean(0).sqrt()) for name in ("twin", "initial twin")}
    label, size = r"effective angle of attack $\alpha_e$ [deg]", (7.5, 8.4)
    figure, axes = style.grid(3, title="Polars of the wing", size=size, xlabel=label, height_ratios=(2.0, 2.0, 1.0))
    angle = torch.linspace(-180.0, 180.0, 361, dtype=visited.dtype, device=visited.device)
    around = torch.stack([angle.deg2rad().sin(), angle.deg2rad().cos()], -1)
    for name, closure in style.closures(snapshot).items():
        for ax, values in zip(axes, array(closure(around)).T, strict=False):
            ax.plot(array(angle), values, **style.closure_look(name))
    edges = np.arange(-180.0, 180.0 + BIN, BIN)
    anywhere = np.degrees(np.arctan2(*array(everywhere).reshape(-1, 2).T))
    filled = np.histogram(anywhere, edges)[0] > 0
    for k, name in enumerate(("lift coefficient $C_L$ [-]", "drag coefficient $C_D$ [-]")):
        note = f"RMS where visited {rms['twin'][k]:.2g}, initial {rms['initial twin'][k]:.2g}"
        caption(axes[k], name, note)
        # An edge borders on two bins.
        style.veil(axes[k], edges, np.append(filled, False) | np.append(False, filled))
    share = np.full(len(visited), 100.0 / len(visited))
    axes[2].hist(np.degrees(np.arctan2(*array(visited).T)), edges.tolist(), weights=share, color=SAMPLES)
    caption(axes[2], f"share of the flight [%] per {BIN:g} deg at {SPAN_SHARE:.0%} of the span")
    axes[2].set_xticks(np.arange(-180, 181, 45))
    axes[2].set_xlim(-180.0, 180.0)
    style.legend_below(figure, axes[:1])
    return figure


def control_surfaces(snapshot: Snapshot) -> Figure:
    """Both actions over the errors of x and of z and their rates; other observations are zero (paper, fig. 18)."""
    count = len(snapshot.plant.actions)
    title = f"Policies after episode {len(snapshot.episodes)}\nobservations that are not shown are zero"
    figure, axes = style.panels(2, 2 * count, title=title, size=(16.0, 6.8))
    zero = torch.zeros(len(snapshot.plant.observations), dtype=torch.float64, device=snapshot.record.states.device)
    for k in range(count):
        pair = axes[:, 2 * k : 2 * k + 2]
        contours(snapshot, k, {(0, 2): pair[0], (1, 3): pair[1]}, others=zero)
    style.legend_below(figure, [axes[0, 0]])
    return figure
