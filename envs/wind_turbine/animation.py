"""The last episode of the turbine as an animation: the rotor in the wind, beside speed, power and pitch."""

from pathlib import Path
from typing import cast

import numpy as np
import torch

from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.figures.animation import Trace, TracedScene, save_scene, shown_samples
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import REAL, REFERENCE, SAMPLES, array

TURN = 25.0
"""Angle by which the rotor turns between two frames at rated speed [deg]; its true angle would seem to jump."""
HUB, TIP = 90.0, 63.0
"""Height of the hub and radius of the rotor [m]."""
CHORD = 6.0
"""Width of a drawn blade at zero pitch [m]; it shrinks by the cosine of the pitch."""
ARROW = 3.0
"""Length of the wind's arrow for each m/s [m]."""


def save_animation(snapshot: Snapshot, path: Path | str) -> Path:
    """Write the last real episode as a GIF of five seconds.

    The rotor is seen from the front. Its blades turn as much slower than the real ones as the episode is quicker, and
    narrow with the pitch; the arrow is the wind. Beside it stand wind, generator speed, power and pitch up to the
    present, with the references that the paper's cost follows.

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
        plant, record = cast(WindTurbine, snapshot.plant), snapshot.record
        state, n = record.states[:-1], len(record.actions)
        super().__init__(snapshot, 4, title="Wind turbine", size=(9.0, 5.6), width_ratios=(1.15, 1.0))
        self.wind, self.pitch = array(record.exogenous[:, 0]), array(record.actions[:, 1])
        speed = array(state[:, 0]) / plant.rated_rotor_speed
        # The angle of a frame is the sum of what the frames before it have turned.
        shown = shown_samples(n)
        turned = np.cumsum(TURN * speed[shown])
        self.angle = dict(zip(shown, np.radians(turned), strict=True))
        self._draw_tower()
        omega_g, power = plant.gear_ratio * state[:, 0], 1e-6 * plant.generator_power(state, record.actions)
        held = array(plant.reference_speed(state[:, 2])), array(1e-6 * plant.reference_power(omega_g))
        wind, rotor, made, pitch = self.beside
        self.traces = [
            Trace(wind, self.time, self.wind, r"wind speed $u$ [m/s]", style={"linewidth": 0.8, "color": SAMPLES}),
            Trace(rotor, self.time, array(omega_g), r"generator speed $\omega_g$ [rad/s]", setpoint=held[0]),
            Trace(made, self.time, array(power), "generator power [MW]", setpoint=held[1]),
            Trace(pitch, self.time, self.pitch, r"blade pitch $\beta$ [deg]"),
        ]

    def _draw_tower(self) -> None:
        ax = self.ax
        ax.set(xlim=(-95.0, 95.0), ylim=(-5.0, 165.0), aspect="equal")
        ax.axis("off")
        ax.axhline(0.0, color="0.6", linewidth=1.0)
        ax.fill([-3.0, -2.0, 2.0, 3.0], [0.0, HUB, HUB, 0.0], color="0.75")
        self.blades = [ax.fill([0.0], [0.0], color=REAL)[0] for _ in range(3)]
        (self.hub,) = ax.plot([0.0], [HUB], "o", color=REFERENCE, markersize=7)
        self.arrow = ax.quiver(
            [-90.0], [150.0], [0.0], [0.0], color=SAMPLES, angles="xy", scale_units="xy", scale=1.0, width=0.012
        )
        self.note = ax.text(-90.0, 156.0, "", fontsize=9)
        self.own += [*self.blades, self.hub, self.arrow, self.note]

    def show(self, k: int) -> None:
        """Move everything to sample ``k``."""
        width = 0.5 * CHORD * np.cos(np.radians(self.pitch[k]))
        outline = np.array([[0.0, 0.0], [width, 12.0], [0.25 * width, TIP], [-0.25 * width, TIP], [-width, 12.0]])
        for number, blade in enumerate(self.blades):
            angle = self.angle[k] + 2.0 * np.pi * number / 3.0
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            blade.set_xy(outline @ turn + [0.0, HUB])
        self.arrow.set_UVC([ARROW * self.wind[k]], [0.0])
        self.note.set_text(f"wind {self.wind[k]:.1f} m/s")
        for trace in self.traces:
            trace.show(k)
        self.caption.show(f"time {self.time[k]:.0f} {self.unit}", f"pitch {self.pitch[k]:.1f} deg")
