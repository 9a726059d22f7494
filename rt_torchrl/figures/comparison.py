"""Figures of controllers beside each other: one episode, and all unseen episodes."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rt_torchrl.evaluation.unseen import Judged
from rt_torchrl.figures import style
from rt_torchrl.figures.style import REFERENCE, ROLES, array, caption, legend_below, panels
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Trajectory

OTHERS = ("0.35", "#CC79A7", "#7f3c8d", "#a0522d")
"""Colours of controllers that are no policies."""
COLOURS: Mapping[str, str] = {str(role): colour for role, colour in ROLES.items()}
WIDEST_LINEAR = 30.0
"""Ratio of the greatest to the least value above which a panel is logarithmic."""


@torch.no_grad()
def flights(plant: Plant, flown: Mapping[str, Trajectory], *, where: str = "") -> Figure:
    """Setpoints and actions of one episode under several controllers, over time.

    A plant that states no setpoints shows its states. The setpoints drawn are those of the first controller.

    Args:
        plant: physics that the states are those of.
        flown: an episode under each controller, by name, with the policy that matters most first; none has a batch
            dimension, and states beyond those of the plant are left out.
        where: where the episode was flown, if not on the system, such as on the twin.
    """
    curves = {name: _held(plant, flight) for name, flight in flown.items()}
    labels, intervals = list(next(iter(curves.values()))), max(len(flight.actions) for flight in flown.values())
    rows = len(labels) + len(plant.actions)
    size = (8.5, 1.0 + 1.75 * rows)
    figure, axes, time = style.timeline(plant, intervals, rows, title=f"One unseen episode {where}".strip(), size=size)
    for place, (name, flight) in enumerate(flown.items()):
        look: dict[str, Any] = {"color": COLOURS.get(name, OTHERS[place % len(OTHERS)])}
        look |= {"linewidth": 2.0 if place == 0 else 1.1, "label": style.role_name(name) if name in ROLES else name}
        actions = array(flight.actions)
        for ax, quantity in zip(axes, labels, strict=False):
            value, setpoint = curves[name][quantity]
            ax.plot(time[: len(actions)], value, **look)
            if setpoint is not None and place == 0:
                ax.plot(time[: len(actions)], setpoint, label="setpoint", zorder=3, **style.REFERENCE_LINE)
        for k, ax in enumerate(axes[len(labels) :]):
            ax.step(time[: len(actions)], actions[:, k], where="post", **look)
    for ax, label in zip(axes, (*labels, *(signal.label for signal in plant.actions)), strict=True):
        caption(ax, label)
    for ax, signal in zip(axes[len(labels) :], plant.actions, strict=True):
        style.limits(ax, signal)
    legend_below(figure, axes)
    return figure


def _held(plant: Plant, flight: Trajectory) -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
    """Value and setpoint of each quantity at the start of every interval; the states where there are no setpoints."""
    states = flight.states[:-1, : len(plant.states)]
    setpoints = plant.setpoints(states, flight.actions, flight.exogenous)
    if setpoints:
        return {label: (array(value), array(setpoint)) for label, (value, setpoint) in setpoints.items()}
    return {signal.label: (array(states[:, k]), None) for k, signal in enumerate(plant.states)}


def unseen(judged: Mapping[str, Judged], *, where: str = "") -> Figure:
    """J_a and every quantity of the plant's merit by controller, a point for each episode and a bar at each mean.

    Args:
        judged: results of each controller by name, with the policies first.
        where: words of the title that say where the episodes were flown, such as "on the twin".
    """
    first = next(iter(judged.values()))
    quantities = {"$J_a$": {name: judgement.control_costs for name, judgement in judged.items()}}
    quantities |= {name: {who: judgement.merit[name] for who, judgement in judged.items()} for name in first.merit}
    place = f" {where}" if where else ""
    between = " " if first.merit else "\n"  # a single panel is narrower than the title in one line
    title = f"{len(first.control_costs)} unseen episodes{place},{between}a point each; bar: mean"
    figure, axes = panels(1, len(quantities), title=title, size=(max(4.5, 3.1 * len(quantities)), 4.2))
    for ax, (name, values) in zip(axes.flat, quantities.items(), strict=True):
        _strip(ax, {who: array(points) for who, points in values.items()})
        caption(ax, name)
    return figure


def _strip(ax: Axes, values: Mapping[str, np.ndarray]) -> None:
    """Draw a column of points for each controller, spread sideways so that they do not hide each other."""
    rng = np.random.default_rng(0)
    for column, (who, points) in enumerate(values.items()):
        place = column + 0.25 * rng.uniform(-1.0, 1.0, len(points))
        look: dict[str, Any] = {"color": COLOURS.get(who, REFERENCE), "alpha": 0.6, "markersize": 4.5}
        ax.plot(place, points, "o", markeredgewidth=0.0, **look)
        ax.plot([column - 0.35, column + 0.35], [points.mean()] * 2, color="0.1", linewidth=2.0)
    style.logarithmic_if_wide(ax, WIDEST_LINEAR)
    # Names take two lines, because four of them beside each other are wider than a panel.
    ax.set_xticks(range(len(values)), [who.replace("_", "-\n") for who in values])
    ax.set_xlim(-0.6, len(values) - 0.4)
