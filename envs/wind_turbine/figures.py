"""Figures of the wind turbine: its set-points and its power coefficient."""

from typing import Any, cast

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.figures import style
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import FILTERED, REAL, REFERENCE_LINE, TWIN, array, caption

CONTOURS = (0.1, 0.2, 0.3, 0.4, 0.45)
GREATEST_SHOWN = 0.1
"""Difference of C_p at which its colours end."""
WIND_LABEL = r"wind speed $u$ [m/s]"
SPEED_LABEL = r"generator speed $\omega_g$ [rad/s]"
PITCH_LABEL = r"blade pitch $\beta$ [deg]"


def figures_of(snapshot: Snapshot) -> dict[str, Figure]:
    """Every figure of the wind turbine, by name."""
    return {figure.__name__: figure(snapshot) for figure in (power_and_speed, power_coefficient)}


@torch.no_grad()
def power_and_speed(snapshot: Snapshot) -> Figure:
    """The last episode: wind, generator speed and power beside their references, torque and pitch (paper, fig. 00).

    The reference speed follows the filtered wind, and the policies compare the filtered speed with it.
    """
    plant, record = cast(WindTurbine, snapshot.plant), snapshot.record
    state = record.states[:-1]
    omega_g = plant.gear_ratio * state[:, 0]
    title = f"Power and speed, {style.episode(snapshot)}"
    figure, axes, time = style.timeline(plant, len(state), 5, title=title, size=(8.5, 9.5))
    wind, speed, power, torque, pitch = axes

    def draw(ax: Axes, values: Tensor, label: str, **look: Any) -> None:
        usual: dict[str, Any] = {"color": REAL, "linewidth": 1.5}
        ax.plot(time[:-1], array(values), label=label, **usual | look)

    draw(wind, record.exogenous[:, 0], "wind", linewidth=0.9)
    draw(wind, state[:, 2], "filtered", color=FILTERED, linewidth=2.0)
    draw(speed, omega_g, style.record_label(snapshot))
    draw(speed, state[:, 1], "filtered", color=FILTERED, linewidth=2.0)
    draw(speed, plant.reference_speed(state[:, 2]), r"reference $\tilde\omega_g$", **REFERENCE_LINE)
    draw(power, 1e-6 * plant.generator_power(state, record.actions), style.record_label(snapshot))
    draw(power, 1e-6 * plant.reference_power(omega_g), r"reference $\tilde P$", **REFERENCE_LINE)
    draw(torque, 1e-3 * record.actions[:, 0], "applied", drawstyle="steps-post")
    draw(pitch, record.actions[:, 1], "applied", drawstyle="steps-post")
    style.limits(torque, plant.actions[0], 1e-3)
    style.limits(pitch, plant.actions[1])
    power_label, torque_label = r"generator power $\tau_g\omega_g$ [MW]", r"generator torque $\tau_g$ [kN m]"
    names = (WIND_LABEL, SPEED_LABEL, power_label, torque_label, PITCH_LABEL)
    for ax, name in zip(axes, names, strict=True):
        caption(ax, name)
        style.legend_above(ax)
    return figure


@torch.no_grad()
def power_coefficient(snapshot: Snapshot) -> Figure:
    """C_p over λ and β: the true table, the learned law beside it, and their difference.

    Dots are operating points of the last episode, because a twin can only know what was visited. The colours of the
    difference end at ``GREATEST_SHOWN``, which they reach far from the dots.
    """
    record = snapshot.record
    lam, beta = record.states[:-1, 0] * WindTurbine.radius / record.exogenous[:, 0], record.actions[:, 1]
    grid: dict[str, Any] = {"dtype": lam.dtype, "device": lam.device}
    lams = torch.linspace(2.0, max(13.0, lam.max().item()), 89, **grid)
    betas = torch.linspace(0.0, max(20.0, beta.max().item()), 81, **grid)
    everywhere, visited = torch.stack(torch.meshgrid(lams, betas, indexing="xy"), -1), torch.stack([lam, beta], -1)
    C_p = {name: array(closure(everywhere).squeeze(-1)) for name, closure in style.closures(snapshot).items()}
    true, *others = (closure(visited).squeeze(-1) for closure in style.closures(snapshot).values())
    rms, rms_initial = ((C_p - true).square().mean().sqrt().item() for C_p in others)
    title = f"Power coefficient, RMS error where visited: {rms:.2g}, initial twin {rms_initial:.2g}"
    figure, axes = style.panels(1, 3, title=title, size=(12.0, 4.8), sharex=True, sharey=True)
    table, law, error = axes.flat
    for ax, name in ((table, "true"), (law, "twin")):
        drawn = ax.pcolormesh(array(lams), array(betas), C_p[name], shading="gouraud", vmin=0.0, vmax=0.5)
        lines = ax.contour(array(lams), array(betas), C_p[name], CONTOURS, colors="white", linewidths=0.8)
        ax.clabel(lines, fontsize=8)
    caption(table, "$C_p$ of the plant's own table [-]" if snapshot.true_closure is None else "true $C_p$ [-]")
    caption(law, "$C_p$ of the twin [-]")
    figure.colorbar(drawn, ax=[table, law], extend="both", pad=0.01)
    ends: dict[str, Any] = {"cmap": "RdBu", "vmin": -GREATEST_SHOWN, "vmax": GREATEST_SHOWN}
    drawn = error.pcolormesh(array(lams), array(betas), C_p["twin"] - C_p["true"], shading="gouraud", **ends)
    figure.colorbar(drawn, ax=error, extend="both", pad=0.02)
    caption(error, "twin less true [-]")
    for ax in axes.flat:
        ax.plot(array(lam), array(beta), ".", color=TWIN, markersize=2.5, alpha=0.6, label="visited")
        ax.set_xlabel(r"tip-speed ratio $\lambda$ [-]")
    table.set_ylabel(PITCH_LABEL)
    table.set_xlim(lams[0].item(), lams[-1].item())
    table.set_ylim(betas[0].item(), betas[-1].item())
    style.legend_below(figure, [table])
    return figure
