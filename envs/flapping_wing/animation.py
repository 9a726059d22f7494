"""The last flight as an animation."""

from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist

from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.figures.animation import MovingCaption, save_scene
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import REAL, REFERENCE, SAMPLES, array, last_episode, legend_below, panels


def save_animation(snapshot: Snapshot, path: Path | str) -> Path:
    """Write the last real flight as a GIF, in real time if it lasts five seconds.

    The drone is drawn enlarged: its body, its stroke plane with the pitch β_w and a length proportional to A_φ, the
    normal along which it is pushed, and the wing at its phase in the stroke. At 25 frames per second a beat of 20 Hz
    looks like a beat of 5 Hz.

    Args:
        snapshot: snapshot with the flight.
        path: path of the file, which ends in ``.gif``.

    Returns:
        The path of the file.

    Raises:
        ValueError: if the file has another suffix.
    """
    return save_scene(_Scene(snapshot), len(snapshot.record.states), path)


class _Scene:
    """The picture at any sample of the record."""

    def __init__(self, snapshot: Snapshot):
        self.plant = cast(FlappingWing, snapshot.plant)
        self.place = array(snapshot.record.states)[:, :2]
        # The sample at the end has no interval of its own; it shows the last interval.
        last = len(snapshot.record.actions) - 1
        held = np.minimum(np.arange(len(self.place)), last)
        self.actions, self.wind = array(snapshot.record.actions)[held], array(snapshot.record.exogenous)[held, 0]
        title = f"Flight, episode {last_episode(snapshot)}"
        self.figure, ((self.ax,),) = panels(1, title=title, size=(6.2, 6.4))
        self._draw_still()
        self._prepare_moving()

    def _draw_still(self) -> None:
        ax, target = self.ax, array(self.plant.target)
        ax.plot(*target, "*", color=REFERENCE, markersize=16, label="target")
        low, high = _square(np.vstack([self.place, target]))
        self.width = high[0] - low[0]
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        ax.set_xlabel(self.plant.states[0].label)
        ax.set_ylabel(self.plant.states[1].label)

    def _prepare_moving(self) -> None:
        ax = self.ax
        self.caption = MovingCaption(ax)
        bar = {"solid_capstyle": "round"}
        (self.trail,) = ax.plot([], [], color="0.6", linewidth=1.4)
        (self.plane,) = ax.plot([], [], color=SAMPLES, linewidth=3.0, label=r"stroke plane, as long as $A_\phi$", **bar)
        (self.normal,) = ax.plot([], [], color="0.45", linewidth=1.5, label="normal")
        (self.wing,) = ax.plot([], [], color=REAL, linewidth=2.5, label="wing", **bar)
        (self.body,) = ax.plot([], [], "o", color=REAL, markersize=6)
        legend_below(self.figure, [ax])
        arrow = {"color": SAMPLES, "scale": 12.0, "scale_units": "width", "width": 0.009}
        self.arrow = ax.quiver([0.2], [0.93], [0.0], [0.0], transform=ax.transAxes, **arrow)
        self.wind_text = ax.text(0.2, 0.96, "", transform=ax.transAxes, ha="center", fontsize=9)

    @property
    def moving(self) -> list[Artist]:
        """What :meth:`show` moves."""
        drone: list[Artist] = [self.trail, self.plane, self.normal, self.wing, self.body]
        return [*drone, self.arrow, self.wind_text, *self.caption.moving]

    def show(self, k: int) -> None:
        """Move everything to sample ``k``."""
        A_phi, beta_w = self.actions[k]
        t, body = k * self.plant.dt, self.place[k]
        along, across = _stroke_axes(np.radians(beta_w))
        reach = 0.075 * self.width * A_phi / self.plant.actions[0].high
        phase = np.cos(2.0 * np.pi * self.plant.frequency * t)
        self.trail.set_data(*self.place[: k + 1].T)
        self.plane.set_data(*np.stack([body - reach * along, body + reach * along], -1))
        self.wing.set_data(*np.stack([body, body + reach * phase * along], -1))
        self.normal.set_data(*np.stack([body, body + reach * across], -1))
        self.body.set_data(*body[:, None])
        self.arrow.set_UVC([-self.wind[k]], [0.0])
        self.wind_text.set_text(f"headwind {round(self.wind[k], 1) + 0.0:.1f} m/s")
        note = rf"$A_\phi$ = {A_phi:.0f} deg,  $\beta_w$ = {beta_w:+.0f} deg"
        self.caption.show(f"time {t:.2f} s", note)


def _stroke_axes(beta_w: float) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Unit vectors in (x, z) along the stroke plane and across it, upwards; β_w in rad."""
    return np.array([np.cos(beta_w), np.sin(beta_w)]), np.array([-np.sin(beta_w), np.cos(beta_w)])


def _square(points: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Corners of a square around all points, with a margin for the drone."""
    low, high = points.min(0), points.max(0)
    half = 0.6 * max((high - low).max(), 1e-3)
    return 0.5 * (low + high) - half, 0.5 * (low + high) + half
