"""Both policies as functions of what they observe."""

import math

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from rt_torchrl.figures.style import ROLES, array, caption, legend_below, limits, panels, role_name
from rt_torchrl.signal import Signal
from rt_torchrl.snapshot import Snapshot
from rt_torchrl.switching import Role

RESOLUTION = 81
"""Points along each observation."""
SHOWN = 400
"""Visited observations that are shown at most; more would hide the contours."""


def policy_contours(snapshot: Snapshot) -> Figure:
    """Every action as a function of the observations, model-based beside model-free on the same colour scale.

    Dots are observations of the last real episode; the axes span the declared range of the observations and those.
    With one observation the figure holds curves; with more than two, contours over the first two, the others held at
    their mean in the episode.
    """
    return _curves(snapshot) if len(snapshot.plant.observations) == 1 else _contours(snapshot)


@torch.no_grad()
def visited_observations(snapshot: Snapshot) -> Float[Tensor, "n n_o"]:
    """What the live policy saw in the last real episode."""
    plant, record = snapshot.plant, snapshot.record
    t = plant.dt * torch.arange(len(record.actions), dtype=torch.float64, device=record.states.device)
    return plant.observe(t, record.states[:-1], record.exogenous)


def _curves(snapshot: Snapshot) -> Figure:
    plant, seen = snapshot.plant, visited_observations(snapshot)
    axis = _axis(plant.observations[0], seen[:, 0])
    figure, axes = panels(len(plant.actions), title="Policies", size=(6.5, 1.2 + 2.4 * len(plant.actions)), sharex=True)
    for role in ROLES:
        values = _evaluate(snapshot, role, axis[:, None])
        for k, ax in enumerate(axes.flat):
            ax.plot(array(axis), values[:, k], color=ROLES[role], linewidth=1.8, label=role_name(role))
    shown = array(seen[:: -(-len(seen) // SHOWN), 0])
    for ax, action in zip(axes.flat, plant.actions, strict=True):
        limits(ax, action)
        rug = {"transform": ax.get_xaxis_transform(), "color": "0.4", "alpha": 0.4, "markersize": 7}
        ax.plot(shown, np.full_like(shown, 0.02), "|", label="visited", **rug)
        caption(ax, action.label)
    axes[-1, 0].set_xlabel(plant.observations[0].label)
    axes[-1, 0].set_xlim(axis[0].item(), axis[-1].item())
    legend_below(figure, axes.flat)
    return figure


def _contours(snapshot: Snapshot) -> Figure:
    plant, seen = snapshot.plant, visited_observations(snapshot)
    x, y = (_axis(signal, seen[:, k]) for k, signal in enumerate(plant.observations[:2]))
    plane = torch.cartesian_prod(x, y)
    points = torch.cat([plane, seen[:, 2:].mean(0).expand(len(plane), -1)], -1)
    others = "" if seen.shape[1] == 2 else "\nother observations at their mean in the last episode"
    rows = len(plant.actions)
    figure, axes = panels(rows, 2, title=f"Policies{others}", size=(9.5, 1.0 + 2.9 * rows), sharex=True, sharey=True)
    values = {role: _evaluate(snapshot, role, points).reshape(RESOLUTION, RESOLUTION, -1) for role in ROLES}
    for k, action in enumerate(plant.actions):
        levels = _levels([field[..., k] for field in values.values()])
        for role, ax in zip(ROLES, axes[k], strict=True):
            filled = ax.contourf(array(x), array(y), values[role][..., k].T, levels=levels, cmap="viridis")
            _scatter(ax, array(seen))
            caption(ax, role_name(role), "live" if role == snapshot.live else "idle")
        figure.colorbar(filled, ax=list(axes[k]), label=action.label, aspect=16)
        axes[k, 0].set_ylabel(plant.observations[1].label)
    for ax in axes[-1]:
        ax.set_xlabel(plant.observations[0].label)
    legend_below(figure, [axes[0, 0]])
    return figure


def _scatter(ax: Axes, seen: Float[np.ndarray, "n n_o"]) -> None:
    shown = seen[:: -(-len(seen) // SHOWN)]
    style = {"s": 9, "color": "white", "edgecolors": "black", "linewidths": 0.4, "alpha": 0.6}
    ax.scatter(shown[:, 0], shown[:, 1], label="visited in the last episode", **style)


@torch.no_grad()
def _evaluate(snapshot: Snapshot, role: Role, points: Float[Tensor, "m n_o"]) -> Float[np.ndarray, "m n_a"]:
    return array(snapshot.policies[role](points))


def _axis(signal: Signal, seen: Float[Tensor, " n"]) -> Float[Tensor, " m"]:
    """Points from end to end of what is declared and what was visited, so that no dot lies outside."""
    ends = [end for end in (signal.low, signal.high) if math.isfinite(end)]
    low, high = min(ends + [seen.min().item()]), max(ends + [seen.max().item()])
    if low == high:
        low, high = low - 1.0, high + 1.0
    return torch.linspace(low, high, RESOLUTION, dtype=seen.dtype, device=seen.device)


def _levels(fields: list[Float[np.ndarray, "m m"]]) -> Float[np.ndarray, " levels"]:
    """Round levels around everything the policies do here; a constant gets levels of its own."""
    low, high = min(field.min() for field in fields), max(field.max() for field in fields)
    margin = max(1e-6 * max(abs(low), abs(high)), 1e-12) if high - low < 1e-9 * max(abs(low), abs(high), 1e-3) else 0.0
    return MaxNLocator(12).tick_values(low - margin, high + margin)
