"""Figures of the wind turbine: its set-points, its power coefficient, the agreement of its twin."""

from typing import Any, NamedTuple, cast

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor, nn

from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import (
    CLOSURE_LINES,
    FILTERED,
    LIMITS,
    REAL,
    REFERENCE_LINE,
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
)

PITCHES = (0.0, 5.0, 10.0, 15.0)
"""Pitch angles at which C_p is drawn [deg]."""
PITCH_COLOURS = colormaps["viridis"]([0.0, 0.35, 0.65, 0.9])
LEAST_SHOWN = -0.25
"""C_p below which operating points are only counted: an overspeeding rotor brakes at a C_p down to about -1."""


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
    time, label = time_axis(plant, len(state))
    omega_g = plant.gear_ratio * state[:, 0]
    figure, axes = panels(5, title=f"Power and speed, episode {last_episode(snapshot)}", size=(8.5, 9.5), sharex=True)
    wind, speed, power, torque, pitch = axes.flat

    def draw(ax: Axes, values: Tensor, label: str, **style: Any) -> None:
        look: dict[str, Any] = {"color": REAL, "linewidth": 1.5} | style
        ax.plot(time, array(values), label=label, **look)

    draw(wind, record.exogenous[:, 0], "wind", linewidth=0.9)
    draw(wind, state[:, 2], "filtered", color=FILTERED, linewidth=2.0)
    draw(speed, omega_g, "real")
    draw(speed, state[:, 1], "filtered", color=FILTERED, linewidth=2.0)
    draw(speed, plant.reference_speed(state[:, 2]), r"reference $\tilde\omega_g$", **REFERENCE_LINE)
    draw(power, 1e-6 * plant.generator_power(state, record.actions), "real")
    draw(power, 1e-6 * plant.reference_power(omega_g), r"reference $\tilde P$", **REFERENCE_LINE)
    draw(torque, 1e-3 * record.actions[:, 0], "applied", drawstyle="steps-post")
    draw(pitch, record.actions[:, 1], "applied", drawstyle="steps-post")
    limits(torque, plant.actions[0], 1e-3)
    limits(pitch, plant.actions[1])
    names = (
        r"wind speed $u$ [m/s]",
        r"generator speed $\omega_g$ [rad/s]",
        r"generator power $\tau_g\omega_g$ [MW]",
        r"generator torque $\tau_g$ [kN m]",
        r"blade pitch $\beta$ [deg]",
    )
    for ax, name in zip(axes.flat, names, strict=True):
        caption(ax, name)
        legend_above(ax)
    pitch.set_xlabel(label)
    pitch.set_xlim(0.0, time[-1] + time[1])
    return figure


def power_coefficient(snapshot: Snapshot) -> Figure:
    """C_p over λ at four pitch angles, and in the last episode over the wind speed (paper, fig. 14b).

    The left panel shows the true table, the learned law and the law that the training started from. Each tick at the
    top is a λ of the episode, in the colour of the pitch angle within 2.5 deg of its own, because a twin can only know
    what was visited. Curves are pale outside the range of those λ.
    """
    visited = _Visited.of(snapshot)
    true, learned, initial = visited.C_p.values()
    rms, rms_initial = (np.sqrt(np.mean((C_p - true) ** 2)) for C_p in (learned, initial))
    figure, ((left, right),) = panels(
        1,
        2,
        title=f"Power coefficient, RMS error where visited: {rms:.2g}, initial twin {rms_initial:.2g}",
        size=(11.0, 4.8),
        width_ratios=(1.25, 1.0),
    )
    _draw_curves(left, snapshot, visited)
    _draw_over_wind(right, visited)
    legend_below(figure, [left])
    return figure


def scatter(snapshot: Snapshot) -> Figure:
    """Generator speed of the twin against the real one at the same instants (paper, fig. 12b)."""
    real, twin = (array(WindTurbine.gear_ratio * s[:, 0]) for s in (snapshot.record.states, snapshot.replay))
    error = twin - real
    figure, ((ax,),) = panels(1, title="Twin against real generator speed", size=(5.4, 5.6))
    ends = [min(real.min(), twin.min()), max(real.max(), twin.max())]
    ax.plot(ends, ends, color=LIMITS, linewidth=1.2, label="perfect twin")
    ax.plot(real, twin, "o", color=TWIN, markersize=3, alpha=0.5, label="sample")
    ax.set_aspect("equal")
    caption(ax, f"bias {error.mean():.2g} rad/s, RMS {np.sqrt(np.mean(error**2)):.2g} rad/s")
    ax.set_xlabel(r"real $\omega_g$ [rad/s]")
    ax.set_ylabel(r"twin $\omega_g$ [rad/s]")
    ax.legend(loc="upper left", fontsize=9, frameon=False)
    return figure


class _Visited(NamedTuple):
    """Operating points of the last episode, and their C_p under each closure."""

    lam: np.ndarray
    beta: np.ndarray
    wind: np.ndarray
    C_p: dict[str, np.ndarray]

    @classmethod
    def of(cls, snapshot: Snapshot) -> "_Visited":
        record = snapshot.record
        wind, beta = record.exogenous[:, 0], record.actions[:, 1]
        lam = record.states[:-1, 0] * WindTurbine.radius / wind
        C_p = {name: _evaluate(closure, lam, beta) for name, closure in closures(snapshot).items()}
        return cls(array(lam), array(beta), array(wind), C_p)


@torch.no_grad()
def _evaluate(closure: nn.Module, lam: Tensor, beta: Tensor) -> np.ndarray:
    return array(closure(torch.stack([lam, beta], -1)).squeeze(-1))


def _draw_curves(ax: Axes, snapshot: Snapshot, visited: _Visited) -> None:
    like: dict[str, Any] = {"dtype": torch.float64, "device": snapshot.record.states.device}
    lam = torch.linspace(2.0, max(13.0, visited.lam.max()), 200, **like)
    for k, (pitch, colour) in enumerate(zip(PITCHES, PITCH_COLOURS, strict=True)):
        near = visited.lam[np.abs(visited.beta - pitch) <= 2.5]
        inside = (array(lam) >= near.min(initial=np.inf)) & (array(lam) <= near.max(initial=-np.inf))
        for (name, style), closure in zip(CLOSURE_LINES.items(), closures(snapshot).values(), strict=True):
            values = _evaluate(closure, lam, torch.full_like(lam, pitch))
            look = {"color": colour, "linestyle": style, "linewidth": 1.6}
            ax.plot(array(lam), values, alpha=0.25, gid=f"{name}, {pitch:g} deg", **look)
            ax.plot(array(lam), np.where(inside, values, np.nan), **look)
        ax.plot(near, np.full_like(near, 0.585 - 0.02 * k), "|", color=colour, markersize=6, alpha=0.6)
        ax.plot([], [], color=colour, label=rf"$\beta$ = {pitch:g} deg")
    for name, style in CLOSURE_LINES.items():
        ax.plot([], [], color=REAL, linestyle=style, label=name)
    ax.axhline(0.0, color="0.7", linewidth=0.8, zorder=0)
    ax.set_ylim(-0.1, 0.6)
    ax.set_xlim(lam[0].item(), lam[-1].item())
    caption(ax, "$C_p$ [-] at four pitch angles", r"ticks: visited $\lambda$, $\beta$ within 2.5 deg")
    ax.set_xlabel(r"tip-speed ratio $\lambda$ [-]")


def _draw_over_wind(ax: Axes, visited: _Visited) -> None:
    ax.plot(visited.wind, visited.C_p["true"], "o", color=REAL, markersize=4, alpha=0.5, label="true")
    ax.plot(visited.wind, visited.C_p["twin"], ".", color=TWIN, markersize=3, alpha=0.8, label="twin")
    hidden = (visited.C_p["true"] < LEAST_SHOWN).mean()
    least = min(visited.C_p["true"].min(), visited.C_p["twin"].min()) - 0.03
    ax.set_ylim(bottom=max(least, LEAST_SHOWN))
    caption(ax, "$C_p$ [-] in the last episode")
    legend_above(ax)
    note = f" ({hidden:.0%} of the true points lie below)" if hidden else ""
    ax.set_xlabel(f"wind speed $u$ [m/s]{note}")
