"""Figures of both policies as functions of their observations."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from rt_torchrl.figures import style
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import ROLES, array, caption, legend_below, role_name
from rt_torchrl.plants.signal import Signal
from rt_torchrl.steps.config import Role
from rt_torchrl.trajectories.state_feedback import StateFeedback

RESOLUTION = 81
"""Number of points along each observation."""
SHOWN = 400
"""Greatest number of visited observations that are shown; more would hide the contours."""
DOTS: dict[str, Any] = {"s": 9, "color": "white", "edgecolors": "black", "linewidths": 0.4, "alpha": 0.6}


@torch.no_grad()
def policy_contours(snapshot: Snapshot) -> Figure:
    """Every action as a function of the observations, model-based beside model-free on the same colour scale.

    Dots are observations of the last real episode; the axes span these and the declared ranges of the observations.
    With one observation the figure shows curves on both sides of zero error. With more observations it shows contours
    over the first two; the others have their mean value in the episode. State feedback, which is no function of the
    observation, has no curve, and a panel with the visited observations alone.
    """
    return _curves(snapshot) if len(snapshot.plant.observations) == 1 else _contours(snapshot)


@torch.no_grad()
def visited_observations(snapshot: Snapshot) -> Float[Tensor, "n n_o"]:
    """Observations of the live policy in the last real episode."""
    plant, record = snapshot.plant, snapshot.record
    t = plant.dt * torch.arange(len(record.actions), dtype=torch.float64, device=record.states.device)
    return plant.observe(t, record.states[:-1], record.exogenous)


def _curves(snapshot: Snapshot) -> Figure:
    plant, seen = snapshot.plant, visited_observations(snapshot)
    # The axis has errors of both signs, so that it shows the target.
    axis = _axis(plant.observations[0], torch.cat([seen[:, 0], -seen[:, 0]]))
    figure, axes = style.grid(
        len(plant.actions),
        title=f"Policies after episode {style.last_episode(snapshot)}",
        size=(6.5, 1.2 + 2.4 * len(plant.actions)),
        xlabel=plant.observations[0].label,
    )
    for role in functions_of_observation(snapshot):
        values = array(snapshot.policies[role](axis[:, None]))
        for k, ax in enumerate(axes):
            ax.plot(array(axis), values[:, k], color=ROLES[role], linewidth=1.8, label=role_name(role))
    shown = array(_some(seen[:, 0]))
    for ax, action in zip(axes, plant.actions, strict=True):
        style.limits(ax, action)
        ax.axvline(0.0, color="0.7", linewidth=0.8, zorder=0)
        rug: dict[str, Any] = {"transform": ax.get_xaxis_transform(), "color": "0.4", "alpha": 0.4, "markersize": 7}
        ax.plot(shown, np.full_like(shown, 0.02), "|", label="visited", **rug)
        caption(ax, action.label)
    axes[0].set_xlim(axis[0].item(), axis[-1].item())
    legend_below(figure, axes)
    return figure


def _contours(snapshot: Snapshot) -> Figure:
    mean, rows = visited_observations(snapshot).mean(0), len(snapshot.plant.actions)
    others = "" if len(mean) == 2 else "\nother observations at their mean in the last episode"
    figure, axes = style.panels(
        rows,
        2,
        title=f"Policies after episode {style.last_episode(snapshot)}{others}",
        size=(9.5, 1.0 + 2.9 * rows),
        sharex=True,
        sharey=True,
    )
    for k in range(rows):
        contours(snapshot, k, {(0, 1): axes[k]}, others=mean)
    for ax in axes[:-1].flat:
        ax.set_xlabel("")
    legend_below(figure, [axes[0, 0]])
    return figure


@torch.no_grad()
def contours(
    snapshot: Snapshot,
    action: int,
    planes: Mapping[tuple[int, int], np.ndarray],
    *,
    others: Float[Tensor, " n_o"],
) -> None:
    """Draw one action over pairs of observations, all on one colour scale.

    Args:
        snapshot: snapshot with the policies and the record.
        action: index of the action.
        planes: two axes, for the model-based and the model-free policy, for each pair of observations by index.
        others: values of the observations that are not in the pair.
    """
    signals, seen = snapshot.plant.observations, visited_observations(snapshot)
    grids = {plane: [_axis(signals[i], seen[:, i]) for i in plane] for plane in planes}
    fields = {}
    for plane, grid in grids.items():
        points = others.expand(RESOLUTION**2, -1).clone()
        points[:, plane] = torch.cartesian_prod(*grid)
        for role in functions_of_observation(snapshot):
            fields[plane, role] = array(snapshot.policies[role](points)[:, action]).reshape(RESOLUTION, RESOLUTION)
    levels = _levels(list(fields.values()))
    for plane, pair in planes.items():
        for role, ax in zip(ROLES, pair, strict=True):
            x, y = map(array, grids[plane])
            if (plane, role) in fields:
                filled = ax.contourf(x, y, fields[plane, role].T, levels=levels, cmap="viridis")
            else:
                place: dict[str, Any] = {"transform": ax.transAxes, "ha": "center", "va": "center", "fontsize": 9}
                ax.text(0.5, 0.5, "plans its actions:\nno function of the observation", **place)
            ax.scatter(*array(_some(seen[:, plane])).T, label="visited in the last episode", **DOTS)
            caption(ax, role_name(role), "live" if role == snapshot.live else "idle")
            ax.set_xlabel(signals[plane[0]].label)
            ax.xaxis.set_major_locator(MaxNLocator(5))
        pair[0].set_ylabel(signals[plane[1]].label)
    every = [ax for pair in planes.values() for ax in pair]
    every[0].figure.colorbar(filled, ax=every, label=snapshot.plant.actions[action].label, aspect=16 * len(planes))


def functions_of_observation(snapshot: Snapshot) -> list[Role]:
    """Roles whose policies can be drawn over observations."""
    return [role for role in ROLES if not isinstance(snapshot.policies[role], StateFeedback)]


def _some(seen: Tensor) -> Tensor:
    """As many of the visited observations as are shown."""
    return seen[:: -(-len(seen) // SHOWN)]


def _axis(signal: Signal, seen: Float[Tensor, " n"]) -> Float[Tensor, " m"]:
    """Points over the declared range and the visited values of a signal, so that no dot lies outside.

    At an end that is not declared there is a margin beyond the visited values.
    """
    least, greatest = seen.min().item(), seen.max().item()
    margin = 0.05 * (greatest - least) or 1.0
    low = min(signal.low, least) if math.isfinite(signal.low) else least - margin
    high = max(signal.high, greatest) if math.isfinite(signal.high) else greatest + margin
    return torch.linspace(low, high, RESOLUTION, dtype=seen.dtype, device=seen.device)


def _levels(fields: list[Float[np.ndarray, "m m"]]) -> Float[np.ndarray, " levels"]:
    """Round levels that include all values of the policies; a constant policy has levels around its value."""
    low, high = min(field.min() for field in fields), max(field.max() for field in fields)
    margin = max(1e-6 * max(abs(low), abs(high)), 1e-12) if high - low < 1e-9 * max(abs(low), abs(high), 1e-3) else 0.0
    return np.asarray(MaxNLocator(12).tick_values(low - margin, high + margin))
