"""Figures of the flapping-wing drone: its flight, the polars of its wings, its policies."""

from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from torch import Tensor

from rt_torchrl.envs.flapping_wing.measurements import ERRORS
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.evaluation.closure_error import visited_features as features_of
from rt_torchrl.figures.policy import contours
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import (
    CLOSURE_LINES,
    LARGE_SCALE,
    LIMIT_LINE,
    REAL,
    REFERENCE,
    REFERENCE_LINE,
    SAMPLES,
    TWIN,
    array,
    caption,
    closures,
    last_episode,
    legend_above,
    legend_below,
    limits,
    panels,
    time_axis,
    twin_label,
    veil,
)

POLAR_COLOURS = {"true": REAL, "twin": TWIN, "initial twin": "0.55"}
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
    """The last flight in the vertical plane with the wind at each second; wind and distance to the target over time.

    The axes span the real flight and the target; a twin that flies elsewhere leaves them.
    """
    figure, axes = panels(
        2, 2, title=f"Flight path, episode {last_episode(snapshot)}", size=(11.0, 5.8), width_ratios=(1.35, 1.0)
    )
    (path, wind), (below, distance) = axes
    below.remove()
    path.set_subplotspec(path.get_gridspec()[:, 0])
    wind.sharex(distance)
    _draw_path(path, snapshot)
    _draw_wind(wind, snapshot)
    _draw_distance(distance, snapshot)
    legend_below(figure, [path])
    return figure


def _draw_path(ax: Axes, snapshot: Snapshot) -> None:
    plant, real, twin = cast(FlappingWing, snapshot.plant), array(snapshot.record.states), array(snapshot.replay)
    wind = array(snapshot.record.exogenous)[:, 0]
    ax.plot(*real[:, :2].T, color=REAL, linewidth=1.9, label="real")
    ax.plot(*real[0, :2], "s", color=REAL, markersize=7, label="start")
    ax.plot(*array(plant.target), "*", color=REFERENCE, markersize=15, label="target")
    # The line is added instead of plotted, so that the axes do not grow to hold it.
    ax.add_artist(Line2D(*twin[:, :2].T, color=TWIN, linewidth=1.0, label=twin_label(snapshot)))
    ax.margins(0.09)
    second = np.arange(round(1.0 / plant.dt), len(real), round(1.0 / plant.dt))
    ax.plot(*real[second, :2].T, "o", color=REAL, markersize=4.5, label="every second")
    style: dict[str, Any] = {
        "color": SAMPLES,
        "width": 0.005,
        "zorder": 3,
        "units": "width",
        "scale": 24.0,
        "scale_units": "width",
    }
    arrows = ax.quiver(*real[second, :2].T, -wind[second - 1], np.zeros(len(second)), **style)
    key = {"labelpos": "N", "coordinates": "axes", "angle": 180.0, "fontproperties": {"size": 9}}
    ax.quiverkey(arrows, 0.9, 0.06, 2.0, "wind 2 m/s", **key)
    _label_seconds(ax, real[second, :2])
    ax.set_aspect("equal", adjustable="datalim")
    caption(ax, "vertical plane")
    ax.set_xlabel(plant.states[0].label)
    ax.set_ylabel(plant.states[1].label)


def _label_seconds(ax: Axes, places: Float[np.ndarray, "seconds 2"]) -> None:
    """Number the seconds, except those in which the drone has hardly moved since the last number."""
    near, last = 0.07 * np.ptp(ax.get_xlim()), np.full(2, np.inf)
    for second, place in enumerate(places, 1):
        if not np.linalg.norm(place - last) < near:
            ax.annotate(f"{second} s", place, (7, -11), textcoords="offset points", fontsize=8.5)
            last = place


def _draw_wind(ax: Axes, snapshot: Snapshot) -> None:
    plant = cast(FlappingWing, snapshot.plant)
    recorded, strongest = array(snapshot.record.exogenous)[:, 0], float(plant.strongest_wind)
    time, _ = time_axis(plant, len(recorded))
    ax.plot(time, recorded, color=REAL, linewidth=1.9, label="recorded")
    if snapshot.large_scale is not None:
        ax.plot(time, array(snapshot.large_scale)[:, 0], color=LARGE_SCALE, linewidth=1.0, label="large scale (SVR)")
    ax.axhline(strongest, **LIMIT_LINE)
    # The text stands on the line itself, because the legend has no room for it.
    text: dict[str, Any] = {"fontsize": 8.5, "color": "0.35", "ha": "right", "va": "center"}
    text["bbox"] = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.0}
    ax.annotate("strongest that can be held", (0.99, strongest), xycoords=("axes fraction", "data"), **text)
    ax.set_ylim(min(0.0, recorded.min()) - 0.2, 1.15 * max(strongest, recorded.max()))
    caption(ax, plant.inputs[0].label)
    legend_above(ax)
    ax.tick_params(labelbottom=False)


def _draw_distance(ax: Axes, snapshot: Snapshot) -> None:
    plant = cast(FlappingWing, snapshot.plant)
    real, twin = (
        np.linalg.norm(array(states[:, :2] - plant.target), axis=1)
        for states in (snapshot.record.states, snapshot.replay)
    )
    time, label = time_axis(plant, len(real))
    ax.plot(time, real, color=REAL, linewidth=1.9, label="real")
    ax.plot(time, twin, color=TWIN, linewidth=1.0, label=twin_label(snapshot))
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())
    caption(ax, "distance to the target [m]", f"at the end {real[-1]:.2g} m, twin {twin[-1]:.2g} m")
    ax.set_xlabel(label)
    ax.set_xlim(time[0], time[-1])


def flight(snapshot: Snapshot) -> Figure:
    """Positions, speeds and actions over time (paper, fig. 17): along x on the left, along z on the right.

    The stroke plane angle stands under the horizontal motion that it drives, the amplitude under the vertical motion.
    Speeds shake with the wing beat, and actions answer them; the figure shows their mean and their range in each beat.
    """
    plant, real, twin = cast(FlappingWing, snapshot.plant), array(snapshot.record.states), array(snapshot.replay)
    applied = array(snapshot.record.actions)
    time, label = time_axis(plant, len(real))
    beat = round(1.0 / (plant.frequency * plant.dt))
    title = f"Flight, episode {last_episode(snapshot)}\nspeeds and actions: mean over each wing beat"
    figure, axes = panels(3, 2, title=title, size=(11.0, 7.4), sharex=True)
    for k, ax in enumerate(axes[0]):
        ax.plot(time, real[:, k], color=REAL, linewidth=1.9, label="real")
        ax.plot(time, twin[:, k], color=TWIN, linewidth=0.9, label=twin_label(snapshot))
        ax.axhline(plant.target[k].item(), label="target", **REFERENCE_LINE)
        caption(ax, plant.states[k].label)
    for k, ax in enumerate(axes[1], 2):
        _draw_beats(ax, time[:-1], real[:-1, k], beat)
        ax.plot(*_mean_over_beats(beat, time[:-1], twin[:-1, k]), color=TWIN, linewidth=0.9, label=twin_label(snapshot))
        ax.axhline(0.0, label="target", **REFERENCE_LINE)
        caption(ax, plant.states[k].label)
    for ax, k in zip(axes[2], (1, 0), strict=True):
        _draw_beats(ax, time[:-1], applied[:, k], beat)
        limits(ax, plant.actions[k])
        caption(ax, plant.actions[k].label)
        ax.set_xlabel(label)
    axes[0, 0].set_xlim(time[0], time[-1])
    legend_below(figure, axes[:, 0].tolist())
    return figure


def _draw_beats(ax: Axes, time: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], beat: int) -> None:
    starts, (middle, mean) = np.arange(0, len(values), beat), _mean_over_beats(beat, time, values)
    least, greatest = (extreme.reduceat(values, starts) for extreme in (np.minimum, np.maximum))
    ax.fill_between(middle, least, greatest, color=SAMPLES, alpha=0.45, linewidth=0, label="range within each beat")
    ax.plot(middle, mean, color=REAL, linewidth=1.9, label="real")


def _mean_over_beats(beat: int, *series: Float[np.ndarray, " n"]) -> list[Float[np.ndarray, " beats"]]:
    """The mean of every ``beat`` samples; the last group may be shorter."""
    starts = np.arange(0, len(series[0]), beat)
    counts = np.diff(np.append(starts, len(series[0])))
    return [np.add.reduceat(values, starts) / counts for values in series]


@torch.no_grad()
def polars(snapshot: Snapshot) -> Figure:
    """C_L and C_D of the true wing, the twin and the initial twin over the effective angle of attack.

    The lowest panel shows how often the last flight had each angle at 70 % of the span, because a twin can only know
    what was visited. Angles that no blade element had are pale.
    """
    visited = visited_features(snapshot)
    C = {name: closure(visited) for name, closure in closures(snapshot).items()}
    rms = {name: array((C[name] - C["true"]).square().mean(0).sqrt()) for name in ("twin", "initial twin")}
    title = "\n".join(["Polars of the wing", *_coefficients(snapshot)])
    figure, axes = panels(3, title=title, size=(7.5, 8.4), sharex=True, height_ratios=(2.0, 2.0, 1.0))
    _draw_polars(axes[:2, 0], snapshot)
    names = ("lift coefficient $C_L$ [-]", "drag coefficient $C_D$ [-]")
    for k, (ax, name) in enumerate(zip(axes[:2, 0], names, strict=True)):
        caption(ax, name, f"RMS where visited {rms['twin'][k]:.2g}, initial {rms['initial twin'][k]:.2g}")
    angle = np.degrees(np.arctan2(*array(visited).T))
    edges = np.arange(-180.0, 180.0 + BIN, BIN)
    anywhere = np.degrees(np.arctan2(*array(features_of(snapshot.plant, snapshot.record)).reshape(-1, 2).T))
    for ax in axes[:2, 0]:
        veil(ax, edges, _touched(anywhere, edges))
    share = np.full(len(angle), 100.0 / len(angle))
    ax = axes[2, 0]
    ax.hist(angle, edges, weights=share, color=SAMPLES)
    caption(ax, f"share of the flight [%] per {BIN:g} deg at {SPAN_SHARE:.0%} of the span")
    ax.set_xlabel(r"effective angle of attack $\alpha_e$ [deg]")
    ax.set_xticks(np.arange(-180, 181, 45))
    ax.set_xlim(-180.0, 180.0)
    legend_below(figure, [axes[0, 0]])
    return figure


def visited_features(snapshot: Snapshot) -> Float[Tensor, "n 2"]:
    """(sin α_e, cos α_e) in the last real flight, at the blade element nearest to ``SPAN_SHARE`` of the span."""
    plant = cast(FlappingWing, snapshot.plant)
    element = (plant.wings.radius - plant.wing_root - SPAN_SHARE * plant.wing_length).abs().argmin()
    return features_of(plant, snapshot.record)[:, element]


def _touched(values: Float[np.ndarray, " n"], edges: Float[np.ndarray, " m"]) -> np.ndarray:
    """Whether each edge borders on a bin that holds a value."""
    filled = np.histogram(values, edges)[0] > 0
    return np.append(filled, False) | np.append(False, filled)


def _draw_polars(axes: np.ndarray, snapshot: Snapshot) -> None:
    angle = torch.linspace(-180.0, 180.0, 361, dtype=torch.float64, device=snapshot.record.states.device)
    radians = torch.deg2rad(angle)
    features = torch.stack([radians.sin(), radians.cos()], -1)
    for name, closure in closures(snapshot).items():
        coefficients, style = array(closure(features)), {"linestyle": CLOSURE_LINES[name], "linewidth": 1.8}
        for ax, values in zip(axes, coefficients.T, strict=True):
            ax.plot(array(angle), values, color=POLAR_COLOURS[name], label=name, **style)


def _coefficients(snapshot: Snapshot) -> list[str]:
    """A line for each law that names its coefficients."""
    found = {name: getattr(law, "named_coefficients", None) for name, law in closures(snapshot).items()}
    return [
        f"{name}: " + ", ".join(f"{letter} = {value:.4g}" for letter, value in named().items())
        for name, named in found.items()
        if named is not None
    ]


def control_surfaces(snapshot: Snapshot) -> Figure:
    """Both actions over the errors of x and of z and their rates; other observations are zero (paper, fig. 18)."""
    actions = snapshot.plant.actions
    figure, axes = panels(
        2,
        2 * len(actions),
        title=f"Policies after episode {last_episode(snapshot)}\nobservations that are not shown are zero",
        size=(16.0, 6.8),
    )
    zero = torch.zeros(len(snapshot.plant.observations), dtype=torch.float64, device=snapshot.record.states.device)
    for k in range(len(actions)):
        pair = axes[:, 2 * k : 2 * k + 2]
        contours(snapshot, k, {(0, 2): pair[0], (1, 3): pair[1]}, others=zero)
    legend_below(figure, [axes[0, 0]])
    return figure
