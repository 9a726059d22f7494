"""Figures of the wind turbine: its set-points, its power coefficient, the agreement of its twin."""

from typing import Any, NamedTuple, cast

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from torch import Tensor, nn

from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import (
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

LEAST_RATIO = 2.0
"""Least tip-speed ratio at which C_p is drawn."""
CONTOURS = (0.1, 0.2, 0.3, 0.4, 0.45)
GREATEST_SHOWN = 0.1
"""Difference of C_p at which its colours end."""
VISITED = "#D55E00"


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
    """C_p over λ and β: the true table, the learned law beside it, and their difference (paper, fig. 14b).

    Dots are operating points of the last episode, because a twin can only know what was visited. The colours of the
    difference end at ``GREATEST_SHOWN``, which they reach far from the dots.
    """
    visited, grid = _Visited.of(snapshot), _Grid.of(snapshot)
    true, learned, initial = visited.C_p.values()
    rms, rms_initial = (np.sqrt(np.mean((C_p - true) ** 2)) for C_p in (learned, initial))
    title = f"Power coefficient, RMS error where visited: {rms:.2g}, initial twin {rms_initial:.2g}"
    figure, axes = panels(1, 3, title=title, size=(12.0, 4.8), sharex=True, sharey=True)
    table, law, error = axes.flat
    for ax, name in ((table, "true"), (law, "twin")):
        drawn = grid.draw(ax, grid.C_p[name], cmap="viridis", vmin=0.0, vmax=0.5)
        lines = ax.contour(grid.lam, grid.beta, grid.C_p[name], CONTOURS, colors="white", linewidths=0.8)
        ax.clabel(lines, fontsize=8)
    caption(table, "true $C_p$ [-]" if snapshot.known else "$C_p$ of the plant's own table [-]")
    caption(law, "$C_p$ of the twin [-]")
    figure.colorbar(drawn, ax=[table, law], extend="both", pad=0.01)
    ends = {"cmap": "RdBu", "vmin": -GREATEST_SHOWN, "vmax": GREATEST_SHOWN}
    drawn = grid.draw(error, grid.C_p["twin"] - grid.C_p["true"], **ends)
    figure.colorbar(drawn, ax=error, extend="both", pad=0.02)
    caption(error, "twin less true [-]")
    for ax in axes.flat:
        ax.plot(visited.lam, visited.beta, ".", color=VISITED, markersize=2.5, alpha=0.6, label="visited")
        ax.set_xlabel(r"tip-speed ratio $\lambda$ [-]")
    table.set_ylabel(r"blade pitch $\beta$ [deg]")
    table.set_xlim(grid.lam[0], grid.lam[-1])
    table.set_ylim(grid.beta[0], grid.beta[-1])
    legend_below(figure, [table])
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


class _Grid(NamedTuple):
    """C_p under each closure over λ and β, ``n_beta n_lambda``, in a range that holds all visited points."""

    lam: np.ndarray
    beta: np.ndarray
    C_p: dict[str, np.ndarray]

    @classmethod
    def of(cls, snapshot: Snapshot) -> "_Grid":
        visited = _Visited.of(snapshot)
        like: dict[str, Any] = {"dtype": torch.float64, "device": snapshot.record.states.device}
        lam = torch.linspace(LEAST_RATIO, max(13.0, visited.lam.max()), 89, **like)
        beta = torch.linspace(0.0, max(20.0, visited.beta.max()), 81, **like)
        pitch, ratio = torch.meshgrid(beta, lam, indexing="ij")
        C_p = {name: _evaluate(closure, ratio, pitch) for name, closure in closures(snapshot).items()}
        return cls(array(lam), array(beta), C_p)

    def draw(self, ax: Axes, values: np.ndarray, **colours: Any) -> QuadMesh:
        """Values over the grid as colours, which end where ``colours`` says."""
        return ax.pcolormesh(self.lam, self.beta, values, shading="gouraud", **colours)


@torch.no_grad()
def _evaluate(closure: nn.Module, lam: Tensor, beta: Tensor) -> np.ndarray:
    return array(closure(torch.stack([lam, beta], -1)).squeeze(-1))
