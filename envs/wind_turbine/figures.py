"""Figures of the wind turbine: its set-points, its power coefficient, the agreement of its twin, and an animation."""

from typing import Any, cast

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.figures import style
from rt_torchrl.figures.animation import Scene, shown_samples
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import FILTERED, REAL, REFERENCE_LINE, SAMPLES, TWIN, array, caption

CONTOURS = (0.1, 0.2, 0.3, 0.4, 0.45)
GREATEST_SHOWN = 0.1
"""Difference of C_p at which its colours end."""
WIND_LABEL = r"wind speed $u$ [m/s]"
SPEED_LABEL = r"generator speed $\omega_g$ [rad/s]"
PITCH_LABEL = r"blade pitch $\beta$ [deg]"
RATIO_LABEL = r"tip-speed ratio $\lambda$ [-]"


def figures_of(snapshot: Snapshot) -> dict[str, Figure]:
    """Every figure of the wind turbine, by name."""
    return {figure.__name__: figure(snapshot) for figure in (power_and_speed, power_coefficient, scatter)}


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
    caption(table, "true $C_p$ [-]" if snapshot.known else "$C_p$ of the plant's own table [-]")
    caption(law, "$C_p$ of the twin [-]")
    figure.colorbar(drawn, ax=[table, law], extend="both", pad=0.01)
    ends: dict[str, Any] = {"cmap": "RdBu", "vmin": -GREATEST_SHOWN, "vmax": GREATEST_SHOWN}
    drawn = error.pcolormesh(array(lams), array(betas), C_p["twin"] - C_p["true"], shading="gouraud", **ends)
    figure.colorbar(drawn, ax=error, extend="both", pad=0.02)
    caption(error, "twin less true [-]")
    for ax in axes.flat:
        ax.plot(array(lam), array(beta), ".", color=TWIN, markersize=2.5, alpha=0.6, label="visited")
        ax.set_xlabel(RATIO_LABEL)
    table.set_ylabel(PITCH_LABEL)
    table.set_xlim(lams[0].item(), lams[-1].item())
    table.set_ylim(betas[0].item(), betas[-1].item())
    style.legend_below(figure, [table])
    return figure


def scatter(snapshot: Snapshot) -> Figure:
    """Generator speed of the twin against the real one at the same instants (paper, fig. 12b)."""
    real, twin = (array(WindTurbine.gear_ratio * s[:, 0]) for s in (snapshot.record.states, snapshot.replay))
    error = twin - real
    figure, ((ax,),) = style.panels(1, title="Twin against real generator speed", size=(5.4, 5.6))
    ends = [min(real.min(), twin.min()), max(real.max(), twin.max())]
    ax.plot(ends, ends, color=style.LIMITS, linewidth=1.2, label="perfect twin")
    ax.plot(real, twin, "o", color=TWIN, markersize=3, alpha=0.5, label="sample")
    ax.set_aspect("equal")
    caption(ax, f"bias {error.mean():.2g} rad/s, RMS {np.sqrt(np.mean(error**2)):.2g} rad/s")
    ax.set_xlabel(r"real $\omega_g$ [rad/s]")
    ax.set_ylabel(r"twin $\omega_g$ [rad/s]")
    ax.legend(loc="upper left", fontsize=9, frameon=False)
    return figure


TURN = 25.0
"""Angle by which the rotor turns between two frames at rated speed [deg]; its true angle would seem to jump."""
HUB, TIP = 90.0, 63.0
"""Height of the hub and radius of the rotor [m]."""
CHORD = 6.0
"""Width of a drawn blade at zero pitch [m]; it shrinks by the cosine of the pitch."""
ARROW = 3.0
"""Length of the wind's arrow for each m/s [m]."""


@torch.no_grad()
def scene(snapshot: Snapshot) -> Scene:
    """The last real episode as an animation.

    The rotor is seen from the front. Its blades turn as much slower than the real ones as the episode is quicker, and
    narrow with the pitch; the arrow is the wind. Beside it stand wind, generator speed, power and pitch, with the
    references that the paper's cost follows and a cursor at the present time.
    """
    plant, record = cast(WindTurbine, snapshot.plant), snapshot.record
    state, wind, pitch = record.states[:-1], array(record.exogenous[:, 0]), array(record.actions[:, 1])
    # The angle of a frame is the sum of what the frames before it have turned.
    shown = shown_samples(len(state))
    turned = np.cumsum(TURN * array(state[:, 0])[shown] / plant.rated_rotor_speed)
    angles = dict(zip(shown, np.radians(turned), strict=True))

    omega_g, power = plant.gear_ratio * state[:, 0], 1e-6 * plant.generator_power(state, record.actions)

    def draw(ax: Axes, k: int) -> str:
        ax.set(xlim=(-95.0, 95.0), ylim=(-5.0, 165.0), aspect="equal")
        ax.axis("off")
        ax.axhline(0.0, color="0.6", linewidth=1.0)
        ax.fill([-3.0, -2.0, 2.0, 3.0], [0.0, HUB, HUB, 0.0], color="0.75")
        width = 0.5 * CHORD * np.cos(np.radians(pitch[k]))
        outline = np.array([[0.0, 0.0], [width, 12.0], [0.25 * width, TIP], [-0.25 * width, TIP], [-width, 12.0]])
        for number in range(3):
            angle = angles[k] + 2.0 * np.pi * number / 3.0
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            ax.fill(*(outline @ turn + [0.0, HUB]).T, color=REAL)
        ax.plot([0.0], [HUB], "o", color=style.REFERENCE, markersize=7)
        units: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0}
        ax.quiver([-90.0], [150.0], [ARROW * wind[k]], [0.0], color=SAMPLES, width=0.012, **units)
        ax.text(-90.0, 156.0, f"wind {wind[k]:.1f} m/s", fontsize=9)
        return f"pitch {pitch[k]:.1f} deg"

    traces = {
        WIND_LABEL: (wind, None),
        SPEED_LABEL: (array(omega_g), array(plant.reference_speed(state[:, 2]))),
        "generator power [MW]": (array(power), 1e-6 * array(plant.reference_power(omega_g))),
        PITCH_LABEL: (pitch, None),
    }
    return Scene(snapshot, draw, title="Wind turbine", size=(9.0, 5.6), traces=traces, width_ratios=(1.15, 1.0))
