"""Animations of the last real episode: a drawing of the plant, traces with a moving cursor beside it, and the file."""

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.lines import Line2D

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.figures import style
from rt_torchrl.figures.snapshot import Snapshot

FRAMES = 125
"""Greatest number of frames: five seconds."""
RATE = 25
"""Frames per second."""
DOTS = 70
"""Dots per inch."""
Draw = Callable[[Axes, int], str]
"""Function that draws a plant into empty axes at the start of a control interval, and returns the note above it."""
Trace = tuple[np.ndarray, np.ndarray | None]
"""Values of a quantity in all control intervals, and its setpoint if it has one."""


class Scene:
    """A drawing of a plant at every control interval, under the time, beside traces below each other on the right.

    Args:
        snapshot: snapshot with the episode.
        draw: function that draws the plant.
        title: what the picture shows; the number of the episode follows.
        size: width and height of the figure [inch].
        traces: the traces by their labels, under a cursor at the present time.
        width_ratios: widths of drawing and traces.
    """

    def __init__(
        self,
        snapshot: Snapshot,
        draw: Draw,
        *,
        title: str,
        size: tuple[float, float],
        traces: Mapping[str, Trace] | None = None,
        width_ratios: tuple[float, ...] = (1.0,),
    ):
        self.intervals, shown = len(snapshot.record.actions), traces or {}
        time, label = style.time_axis(snapshot.plant, self.intervals)
        self._draw, self._time, self._unit = draw, time, label.removeprefix("time [").removesuffix("]")
        self._decimals = max(0, 2 - int(np.log10(time[-1])))
        named, shape = f"{title}, {style.episode(snapshot)}", (len(shown) or 1, len(width_ratios))
        self.figure, axes = style.panels(*shape, title=named, size=size, width_ratios=width_ratios)
        for ax in axes[1:, 0]:
            ax.remove()
        self.ax = axes[0, 0]
        self.ax.set_subplotspec(self.ax.get_gridspec()[:, 0])
        self._cursors, self._drawn = list[Line2D](), list[Artist]()
        for ax, (name, (values, setpoint)) in zip(axes[:, -1], shown.items(), strict=False):
            if setpoint is not None:
                ax.plot(time[:-1], setpoint, **style.REFERENCE_LINE)
            ax.plot(time[:-1], values, color=style.REAL, linewidth=1.0)
            self._cursors.append(ax.axvline(0.0, color=style.TWIN, linewidth=1.2))
            ax.set_xlim(0.0, time[-1])
            ax.tick_params(labelbottom=False)
            style.caption(ax, name)
        if shown:
            axes[-1, -1].tick_params(labelbottom=True)
            axes[-1, -1].set_xlabel(label)
        self.show(0)
        style.legend_below(self.figure, [self.ax])

    def show(self, k: int) -> list[Artist]:
        """Draw the start of control interval ``k``, and return what moves in the order in which it is drawn."""
        for cursor in self._cursors:
            cursor.set_xdata([self._time[k], self._time[k]])
        for artist in self._drawn:
            artist.remove()
        note = self._draw(self.ax, k)
        still: dict[str, Any] = {"transform": self.ax.transAxes, "va": "bottom"}
        moment = f"time {self._time[k]:.{self._decimals}f} {self._unit}"
        self.ax.text(0.0, 1.01, moment, ha="left", fontsize=9.5, **still)
        self.ax.text(1.0, 1.01, note, ha="right", fontsize=9, color="0.35", **still)
        self._drawn = [*self.ax.collections, *self.ax.patches, *self.ax.lines, *self.ax.texts]
        return [*self._cursors, *sorted(self._drawn, key=Artist.get_zorder)]

    def save(self, path: Path | str) -> Path:
        """Write a GIF of at most ``FRAMES`` frames, spread evenly over the control intervals, and return its path.

        Args:
            path: path of the file, which ends in ``.gif``.

        Raises:
            ValueError: if the file has another suffix.
        """
        path = Path(path)
        if path.suffix.lower() != ".gif":
            raise ValueError(f"path={str(path)!r} of the animation must end in '.gif', the format it is written in.")
        from PIL import Image  # here, because only animations need it

        drawn = self._frames(shown_samples(self.intervals))
        # One palette for all frames, of the first and the last one: to find one for each takes most of the time.
        palette = Image.fromarray(np.concatenate([drawn[0], drawn[-1]])).quantize()
        first, *others = (Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in drawn)
        file = io.BytesIO()
        first.save(file, format="GIF", save_all=True, append_images=others, duration=1000 // RATE, loop=0)
        write_atomically(path, file.getvalue())
        return path

    def _frames(self, intervals: Sequence[int]) -> list[np.ndarray]:
        """Pixels of each frame, (height, width, 3) of ``uint8``; what does not move is drawn once."""
        self.figure.set_dpi(DOTS)
        canvas, frames = FigureCanvasAgg(self.figure), []
        self.figure.draw_without_rendering()
        self.figure.set_layout_engine("none")  # every frame has the layout of the first one
        for artist in self.show(0):
            artist.set_animated(True)
        canvas.draw()
        still = canvas.copy_from_bbox(self.figure.bbox)
        for k in intervals:
            canvas.restore_region(still)
            for artist in self.show(k):
                self.figure.draw_artist(artist)
            frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
        return frames


def shown_samples(samples: int) -> list[int]:
    """The samples that frames show, from the first to the last."""
    return np.unique(np.linspace(0, samples - 1, min(FRAMES, samples)).round().astype(int)).tolist()
