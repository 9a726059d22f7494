"""The last episode of the tank as an animation: level, vent and pressure, beside their traces."""

from pathlib import Path
from typing import cast

import numpy as np
import torch

from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.figures.animation import Trace, TracedScene, save_scene
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import FILTERED, REAL, SAMPLES, TWIN, array

PUFFS = 12
"""Greatest number of drawn puffs of vented gas."""


def save_animation(snapshot: Snapshot, path: Path | str) -> Path:
    """Write the last real episode as a GIF of five seconds.

    The tank shows the share of its volume that is liquid, the heat load as an arrow through the wall, and the vent flow
    as puffs behind the valve, as many as its share of the greatest flow of the episode. Beside it stand pressure with
    its set point, vent flow and load up to the present.

    Args:
        snapshot: snapshot with the episode.
        path: path of the file, which ends in ``.gif``.

    Returns:
        The path of the file.

    Raises:
        ValueError: if the file has another suffix.
    """
    return save_scene(_Scene(snapshot), len(snapshot.record.actions), path)


class _Scene(TracedScene):
    """The picture at the start of any interval of the record."""

    @torch.no_grad()
    def __init__(self, snapshot: Snapshot):
        plant, record = cast(CryogenicTank, snapshot.plant), snapshot.record
        state, n = record.states[:-1], len(record.actions)
        super().__init__(snapshot, 3, title="Cryogenic tank", size=(9.0, 5.2), width_ratios=(1.0, 1.5))
        self.pressure, self.fill = 1e-3 * array(state[:, 2]), array(state[:, 1]) / plant.volume
        self.flow = 1e3 * array(plant.vent(state, record.actions, plant.closure).flow)
        self.load = array(record.exogenous[:, 0])
        self._draw_tank()
        held = np.full(n, 1e-3 * plant.set_point)
        above, middle, below = self.beside
        thin = {"linewidth": 0.8}
        self.traces = [
            Trace(above, self.time, self.pressure, "pressure $p$ [kPa]", setpoint=held),
            Trace(middle, self.time, self.flow, r"vent flow $\dot m_c$ [g/s]", style=thin | {"color": SAMPLES}),
            Trace(below, self.time, self.load, plant.inputs[0].label, style=thin | {"color": TWIN}),
        ]

    def _draw_tank(self) -> None:
        ax = self.ax
        ax.set(xlim=(-1.9, 1.9), ylim=(-1.3, 2.3), aspect="equal")
        ax.axis("off")
        round_ = np.linspace(0.0, 2.0 * np.pi, 181)
        self.wall = np.stack([np.cos(round_), np.sin(round_)], -1)
        (self.liquid,) = ax.fill([0.0], [0.0], color=FILTERED, alpha=0.8)
        (self.shell,) = ax.plot(*self.wall.T, color=REAL, linewidth=3.0)
        ax.plot([0.0, 0.0], [1.0, 1.35], color=REAL, linewidth=3.0)
        (self.valve,) = ax.plot([0.0], [1.35], marker="D", color=REAL, markersize=8)
        (self.puffs,) = ax.plot([], [], "o", color="0.7", markersize=5, alpha=0.8)
        self.arrow = ax.quiver(
            [-1.75], [0.0], [0.0], [0.0], color=TWIN, angles="xy", scale_units="xy", scale=1.0, width=0.02
        )
        self.note = ax.text(-1.85, -1.25, "", fontsize=9)
        self.own += [self.liquid, self.shell, self.valve, self.puffs, self.arrow, self.note]

    def show(self, k: int) -> None:
        """Move everything to sample ``k``."""
        height = level(self.fill[k])
        # From one edge of the surface along the wall to the other.
        half = np.arccos(-height)
        angle = np.linspace(-half, half, 91)
        self.liquid.set_xy(np.stack([np.sin(angle), -np.cos(angle)], -1))
        greatest = self.flow.max() or 1.0
        count = round(PUFFS * self.flow[k] / greatest)
        rise = np.arange(count) / PUFFS
        self.puffs.set_data(0.25 * np.sin(9.0 * rise + k) * (0.3 + rise), 1.5 + 0.75 * rise)
        self.valve.set_color(SAMPLES if count else REAL)
        self.arrow.set_UVC([0.7 * self.load[k] / self.load.max()], [0.0])
        self.note.set_text(f"load {self.load[k]:.0f} W, {100.0 * self.fill[k]:.1f} % liquid")
        for trace in self.traces:
            trace.show(k)
        self.caption.show(f"time {self.time[k]:.1f} {self.unit}", f"{self.pressure[k]:.0f} kPa")


def level(fill: float) -> float:
    """Height of the liquid in a sphere of radius 1, from its centre, of which a share of the volume is filled.

    The share is (1 + h)²(2 − h)/4.
    """
    heights = np.linspace(-1.0, 1.0, 401)
    return float(np.interp(fill, 0.25 * (1.0 + heights) ** 2 * (2.0 - heights), heights))
