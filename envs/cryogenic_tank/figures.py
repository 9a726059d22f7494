"""Figures of the cryogenic tank: its days in orbit and its heat exchanger."""

from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor, nn

from rt_torchrl.envs.cryogenic_tank.plant import BAND, CryogenicTank
from rt_torchrl.figures import style
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import REFERENCE_LINE, SAMPLES, TWIN, array, caption

POINTS = 720
"""Greatest number of groups of samples in a drawn record: in five days, ten minutes each, a ninth of an orbit."""


def figures_of(snapshot: Snapshot) -> dict[str, Figure]:
    """Every figure of the tank, by name."""
    # A duty cycle has no pressure drops to draw the exchanger over.
    over_drops = [heat_exchanger] if snapshot.plant.actions[0].name == "valve_drop" else []
    return {figure.__name__: figure(snapshot) for figure in (tank, *over_drops)}


@torch.no_grad()
def tank(snapshot: Snapshot) -> Figure:
    """The last episode: pressure around its set point, masses, wall, vent and load (paper, fig. 21a-b).

    A record of more than ``POINTS`` samples is drawn in groups, each with its mean and range. The axes hold the real
    tank and at most its height again above and below it, so that a twin that is far off leaves them.
    """
    plant, record = cast(CryogenicTank, snapshot.plant), snapshot.record
    real = _quantities(plant, record.states, record.actions, style.closures(snapshot)["true"])
    twin = _quantities(plant, snapshot.replay, record.actions, snapshot.closure)
    group = -(-len(record.actions) // POINTS)
    note = f"\nmean and range of every {group * plant.dt / 60.0:g} min" if group > 1 else ""
    title = f"Tank, {style.episode(snapshot)}{note}"
    figure, axes, time = style.timeline(plant, len(record.actions), len(real) + 1, title=title, size=(9.5, 12.0))
    time, (*of_tank, load) = time[:-1], axes
    target, half = 1e-3 * plant.set_point, 1e-3 * BAND
    band: dict[str, Any] = {"color": style.REFERENCE, "alpha": 0.13, "linewidth": 0, "label": rf"$\pm${half:g} kPa"}
    axes[0].axhspan(target - half, target + half, **band)
    axes[0].axhline(target, label=r"set point $\tilde p$", **REFERENCE_LINE)
    drawn: dict[str, Any] = {"linewidth": 1.5, "label": "_range", "record": style.record_label(snapshot)}
    for ax, (name, values) in zip(of_tank, real.items(), strict=True):
        style.draw_groups(ax, time, array(values), group, **drawn)
        low, high = ax.get_ylim()
        middle, mean = style.means_of_groups(group, time, array(twin[name]))
        ax.plot(middle, mean, color=TWIN, linewidth=0.9, label=style.twin_label(snapshot))
        height = high - low
        ax.set_ylim(max(min(low, mean.min()), low - height), min(max(high, mean.max()), high + height))
        caption(ax, name)
    style.draw_groups(load, time, array(record.exogenous[:, 0]), group, **drawn)
    if snapshot.large_scale is not None:
        mean = array(snapshot.large_scale[:, 0])
        look: dict[str, Any] = {"color": style.LARGE_SCALE, "linewidth": 1.0, "label": "large scale (SVR)"}
        load.plot(*style.means_of_groups(group, time, mean), **look)
        style.legend_above(load)
    caption(load, plant.inputs[0].label)
    style.legend_below(figure, axes[:1])
    return figure


def _quantities(
    plant: CryogenicTank, states: Float[Tensor, "n_plus_1 3"], actions: Float[Tensor, "n 1"], closure: nn.Module
) -> dict[str, Float[Tensor, " n"]]:
    """The quantities that are drawn of a trajectory, at the start of every interval, by label."""
    T_s, V_l, p = states[:-1].unbind(-1)
    now = plant.saturation(p)
    return {
        "pressure $p$ [kPa]": 1e-3 * p,
        "liquid mass $m_l$ [kg]": V_l * now.rho_l,
        "vented mass since the start [kg]": plant.vented_mass(states, actions, closure)[:-1],
        "wall-fluid temperature difference $T_s - T$ [K]": T_s - now.T,
        r"vent flow $\dot m_c$ [g/s]": 1e3 * plant.vent(states[:-1], actions, closure).flow,
    }


@torch.no_grad()
def heat_exchanger(snapshot: Snapshot) -> Figure:
    """Heat taken by the exchanger and load held by the vent over Δp_V at the set point, for each closure.

    The lowest panel shows how often the last episode had each pressure drop, because a twin can only know what was
    visited. Curves are pale outside the range of those drops.
    """
    plant, record = cast(CryogenicTank, snapshot.plant), snapshot.record
    like: dict[str, Any] = {"dtype": torch.float64, "device": record.states.device}
    # The drops are denser towards the shut valve, where the flow is proportional to their root.
    drop = plant.actions[0].high * torch.linspace(0.0, 1.0, 201, **like) ** 2
    state = plant.state_at(torch.full_like(drop, plant.set_point))
    title = f"Heat exchanger at the set point, {1e-3 * plant.set_point:g} kPa"
    label, size = r"pressure drop $\Delta p_V$ [kPa]", (7.5, 8.0)
    figure, (heat, held, share) = style.grid(3, title=title, size=size, xlabel=label, height_ratios=(2.0, 2.0, 1.0))
    for name, closure in style.closures(snapshot).items():
        look, action = style.closure_look(name), drop[:, None]
        heat.plot(1e-3 * array(drop), array(plant.vent(state, action, closure).heat), **look)
        held.plot(1e-3 * array(drop), array(plant.held_load(state, action, closure)), **look)
    mean = record.exogenous.mean().item()
    held.axhline(mean, label="mean load of the last episode", **style.LIMIT_LINE)
    p = record.states[:-1, 2]
    # The back pressure may leave less than the action.
    visited = 1e-3 * array(p - plant.valve_outlet(p, plant.opening(record.actions[:, 0])[0]))
    for ax in (heat, held):
        style.veil(ax, kilopascal := 1e-3 * array(drop), (kilopascal >= visited.min()) & (kilopascal <= visited.max()))
    weight = np.full(len(visited), 100.0 / len(visited))
    share.hist(visited, np.linspace(0.0, 1e-3 * plant.actions[0].high, 41).tolist(), weights=weight, color=SAMPLES)
    caption(heat, "heat taken by the exchanger $Q_{HX}$ [W]")
    caption(held, "load at which the pressure stands still [W]", f"mean load {mean:.3g} W")
    caption(share, "share of the last episode [%] per 5 kPa")
    share.set_xlim(0.0, 1e-3 * plant.actions[0].high)
    style.legend_below(figure, [held])
    return figure
