"""Animations of the last real episode: a drawing of the plant, traces with a moving end beside it, and the file."""

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.figures import style
from rt_torchrl.figures.snapshot import Snapshot

FRAMES = 125
"""Greatest number of frames: five seconds."""
RATE = 25
"""Frames per second."""
DOTS = 80
"""Dots per inch."""
Show = Callable[[int], str]
"""Function that moves a drawing to a control interval, and returns the note above it, beside the time."""
Draw = Callable[[Axes], tuple[Sequence[Artist], Show]]
"""Function that draws a plant, and returns what moves, in the order in which it is drawn over the rest."""


class Trace(NamedTuple):
    """A quantity over time, drawn up to the present sample, with its setpoint drawn whole.

    Args:
        label: label of the quantity with its unit.
        values: values of the samples.
        setpoint: setpoint at the samples; None for none.
        look: further options of the line.
    """

    label: str
    values: np.ndarray
    setpoint: np.ndarray | None = None
    look: Mapping[str, Any] = {}

    def draw(self, ax: Axes, time: np.ndarray) -> tuple[list[Artist], Callable[[int], None]]:
        """Draw the whole trace, which keeps its axes; return what moves, and the function that moves it."""
        if self.setpoint is not None:
            ax.plot(time, self.setpoint, **style.REFERENCE_LINE)
        look: dict[str, Any] = {"color": style.REAL, "linewidth": 1.3} | dict(self.look)
        (line,) = ax.plot(time, self.values, **look)
        (end,) = ax.plot(time[-1:], self.values[-1:], "o", color=look["color"], markersize=4)
        ax.set_xlim(time[0], time[-1])
        ax.set_ylim(ax.get_ylim())
        style.caption(ax, self.label)

        def show(k: int) -> None:
            line.set_data(time[: k + 1], self.values[: k + 1])
            end.set_data(time[k : k + 1], self.values[k : k + 1])

        return [line, end], show


class Scene:
    """A drawing of a plant at every control interval, under the time, beside traces below each other on the right.

    Args:
        snapshot: snapshot with the episode.
        draw: function that draws the plant.
        title: what the picture shows; the number of the episode follows.
        size: width and height of the figure [inch].
        traces: the traces, of a value for each control interval.
        width_ratios: widths of drawing and traces.
    """

    def __init__(
        self,
        snapshot: Snapshot,
        draw: Draw,
        *,
        title: str,
        size: tuple[float, float],
        traces: Sequence[Trace] = (),
        width_ratios: tuple[float, ...] = (1.0,),
    ):
        self.intervals = len(snapshot.record.actions)
        time, label = style.time_axis(snapshot.plant, self.intervals)
        self._time, self._unit = time, label.removeprefix("time [").removesuffix("]")
        self._decimals = max(0, 2 - int(np.log10(time[-1])))
        named = f"{title}, episode {style.last_episode(snapshot)}"
        shape = len(traces) or 1, len(width_ratios)
        self.figure, axes = style.panels(*shape, title=named, size=size, width_ratios=width_ratios)
        for ax in axes[1:, 0]:
            ax.remove()
        self.ax = axes[0, 0]
        self.ax.set_subplotspec(self.ax.get_gridspec()[:, 0])
        self.traces = [trace.draw(ax, time[:-1]) for ax, trace in zip(axes[:, -1], traces, strict=False)]
        if traces:
            for ax in axes[:-1, -1]:
                ax.tick_params(labelbottom=False)
            axes[-1, -1].set_xlabel(label)
        above: dict[str, Any] = {"transform": self.ax.transAxes, "va": "bottom"}
        self._label = self.ax.text(0.0, 1.01, " ", ha="left", fontsize=9.5, **above)
        self._note = self.ax.text(1.0, 1.01, " ", ha="right", fontsize=9, color="0.35", **above)
        drawn, self._show = draw(self.ax)
        style.legend_below(self.figure, [self.ax])
        self.moving = [*drawn, self._label, self._note, *(artist for moving, _ in self.traces for artist in moving)]

    def show(self, k: int) -> None:
        """Move everything to the start of interval ``k``."""
        for _, show in self.traces:
            show(k)
        self._label.set_text(f"time {self._time[k]:.{self._decimals}f} {self._unit}")
        self._note.set_text(self._show(k))

    def save(self, path: Path | str) -> Path:
        """Write a GIF of at most ``FRAMES`` frames, spread evenly over the control intervals, and return its path.

        The figure keeps the layout of the first frame, and what does not move is drawn once.

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

    def _frames(self, samples: Sequence[int]) -> list[np.ndarray]:
        """Pixels of each frame, (height, width, 3) of ``uint8``."""
        self.figure.set_dpi(DOTS)
        canvas = FigureCanvasAgg(self.figure)
        self.show(0)
        self.figure.draw_without_rendering()
        self.figure.set_layout_engine("none")
        for artist in self.moving:
            artist.set_animated(True)
        canvas.draw()
        still, frames = canvas.copy_from_bbox(self.figure.bbox), []
        for k in samples:
            canvas.restore_region(still)
            self.show(k)
            for artist in self.moving:
                self.figure.draw_artist(artist)
            frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
        return frames


def shown_samples(samples: int) -> list[int]:
    """The samples that frames show, from the first to the last."""
    return np.unique(np.linspace(0, samples - 1, min(FRAMES, samples)).round().astype(int)).tolist()
