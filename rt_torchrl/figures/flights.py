"""The figure of one episode under several controllers: what should be held, with its setpoints, and the actions."""

from collections.abc import Mapping

import numpy as np
import torch
from matplotlib.figure import Figure

from rt_torchrl.figures.style import (
    REFERENCE_LINE,
    ROLES,
    array,
    caption,
    legend_below,
    limits,
    panels,
    role_name,
    time_axis,
)
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Trajectory

OTHERS = ("0.35", "#CC79A7", "#7f3c8d", "#a0522d")
"""Colours of controllers that are no policies."""


@torch.no_grad()
def flights(plant: Plant, flown: Mapping[str, Trajectory]) -> Figure:
    """Setpoints and actions of one episode under several controllers, over time.

    A plant that states no setpoints shows its states. The setpoints drawn are those of the first controller.

    Args:
        plant: physics that the states are those of.
        flown: an episode under each controller, by name, with the policy that matters most first; none has a batch
            dimension, and states beyond those of the plant are left out.
    """
    shown = {name: _held(plant, one) for name, one in flown.items()}
    labels = list(next(iter(shown.values())))
    rows = len(labels) + len(plant.actions)
    figure, axes = panels(rows, title="One unseen episode", size=(8.5, 1.0 + 1.75 * rows), sharex=True)
    colours = {str(role): colour for role, colour in ROLES.items()}
    for place, (name, one) in enumerate(flown.items()):
        look = {"color": colours.get(name, OTHERS[place % len(OTHERS)]), "linewidth": 2.0 if place == 0 else 1.1}
        label = role_name(name) if name in ROLES else name
        actions = array(one.actions)
        time, axis = time_axis(plant, len(actions))
        for ax, quantity in zip(axes.flat, labels, strict=False):
            value, setpoint = shown[name][quantity]
            ax.plot(time, value, label=label, **look)
            if setpoint is not None and place == 0:
                ax.plot(time, setpoint, label="setpoint", zorder=3, **REFERENCE_LINE)
        for k, ax in enumerate(axes.flat[len(labels) :]):
            ax.step(time, actions[:, k], where="post", label=label, **look)
    for ax, label in zip(axes.flat, labels, strict=False):
        caption(ax, label)
    for ax, signal in zip(axes.flat[len(labels) :], plant.actions, strict=True):
        limits(ax, signal)
        caption(ax, signal.label)
    axes[-1, 0].set_xlabel(axis)
    axes[-1, 0].set_xlim(time[0], time[-1])
    legend_below(figure, axes.flat[:].tolist())
    return figure


def _held(plant: Plant, one: Trajectory) -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
    """Value and setpoint of each quantity at the start of every interval; the states where there are no setpoints."""
    states = one.states[:-1, : len(plant.states)]
    found = plant.setpoints(states, one.actions, one.exogenous)
    if found:
        return {label: (array(value), array(setpoint)) for label, (value, setpoint) in found.items()}
    return {signal.label: (array(states[:, k]), None) for k, signal in enumerate(plant.states)}
