"""Animations of the last real episode: frames of a scene, traces with a moving end, and the file."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import REAL, REFERENCE_LINE, caption, last_episode, panels, time_axis

FRAMES = 125
"""Greatest number of frames: five seconds."""
RATE = 25
"""Frames per second."""
DOTS = 80
"""Dots per inch."""


@runtime_checkable
class Scene(Protocol):
    """A picture of a plant at any sample of a record."""

    figure: Figure

    @property
    def moving(self) -> Sequence[Artist]:
        """What :meth:`show` moves, in the order in which it is drawn over the rest."""

    def show(self, k: int) -> None:
        """Move everything to sample ``k``."""


def save_scene(scene: Scene, samples: int, path: Path | str) -> Path:
    """Write a scene as a GIF of at most ``FRAMES`` frames, which are spread evenly over the samples.

    Args:
        scene: the scene; its figure keeps the layout of the first frame, and what does not move is drawn once.
        samples: number of samples of the record.
        path: path of the file, which ends in ``.gif``.

    Returns:
        The path of the file.

    Raises:
        ValueError: if the file has another suffix.
    """
    path = Path(path)
    if path.suffix.lower() != ".gif":
        raise ValueError(f"path={str(path)!r} of the animation must end in '.gif', the format it is written in.")
    from PIL import Image  # here, because only animations need it

    drawn = _frames(scene, shown_samples(samples))
    # One palette for all frames, of the first and the last one: to find one for each takes most of the time.
    palette = Image.fromarray(np.concatenate([drawn[0], drawn[-1]])).quantize()
    first, *others = (Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in drawn)
    file = io.BytesIO()
    first.save(file, format="GIF", save_all=True, append_images=others, duration=1000 // RATE, loop=0)
    write_atomically(path, file.getvalue())
    return path


def _frames(scene: Scene, samples: Sequence[int]) -> list[np.ndarray]:
    """Pixels of each frame, (height, width, 3) of ``uint8``."""
    figure = scene.figure
    figure.set_dpi(DOTS)
    canvas = FigureCanvasAgg(figure)
    scene.show(0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for artist in scene.moving:
        artist.set_animated(True)
    canvas.draw()
    still, found = canvas.copy_from_bbox(figure.bbox), []
    for k in samples:
        canvas.restore_region(still)
        scene.show(k)
        for artist in scene.moving:
            figure.draw_artist(artist)
        found.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return found


def shown_samples(samples: int) -> list[int]:
    """The samples that frames show, from the first to the last."""
    return np.unique(np.linspace(0, samples - 1, min(FRAMES, samples)).round().astype(int)).tolist()


class Trace:
    """A quantity over time, drawn up to the present sample, with its setpoint drawn whole.

    Args:
        ax: panel of the trace.
        time: times of the samples.
        values: values of the samples.
        label: label of the quantity with its unit.
        setpoint: setpoint at the samples; None for none.
        style: further options of the line.
    """

    def __init__(
        self,
        ax: Axes,
        time: np.ndarray,
        values: np.ndarray,
        label: str,
        *,
        setpoint: np.ndarray | None = None,
        style: Mapping[str, Any] | None = None,
    ):
        self._time, self._values = time, values
        if setpoint is not None:
            ax.plot(time, setpoint, **REFERENCE_LINE)
        look: dict[str, Any] = {"color": REAL, "linewidth": 1.3} | dict(style or {})
        (self._line,) = ax.plot(time, values, **look)
        (self._end,) = ax.plot(time[-1:], values[-1:], "o", color=look["color"], markersize=4)
        ax.set_xlim(time[0], time[-1])
        ax.set_ylim(ax.get_ylim())  # those of the whole trace
        caption(ax, label)

    @property
    def moving(self) -> list[Artist]:
        """The line, and the point at its end."""
        return [self._line, self._end]

    def show(self, k: int) -> None:
        """Draw the trace up to sample ``k``."""
        self._line.set_data(self._time[: k + 1], self._values[: k + 1])
        self._end.set_data(self._time[k : k + 1], self._values[k : k + 1])


class MovingCaption:
    """A label above a panel on the left and a note on the right, as :func:`caption` writes them, which change.

    Args:
        ax: the panel.
    """

    def __init__(self, ax: Axes):
        above: dict[str, Any] = {"transform": ax.transAxes, "va": "bottom"}
        self._label = ax.text(0.0, 1.01, " ", ha="left", fontsize=9.5, **above)
        self._note = ax.text(1.0, 1.01, " ", ha="right", fontsize=9, color="0.35", **above)

    @property
    def moving(self) -> list[Artist]:
        """Label and note."""
        return [self._label, self._note]

    def show(self, label: str, note: str) -> None:
        """Write other words."""
        self._label.set_text(label)
        self._note.set_text(note)


class TracedScene:
    """A drawing of a plant on the left, with a caption that moves, beside one trace below the other on the right.

    A subclass draws into ``ax``, sets ``traces`` in the panels ``beside``, and adds to ``own`` what it moves itself.

    Args:
        snapshot: snapshot with the episode.
        traces: number of traces.
        title: what the picture shows; the number of the episode follows.
        size: width and height of the figure [inch].
        width_ratios: widths of drawing and traces.
    """

    def __init__(
        self,
        snapshot: Snapshot,
        traces: int,
        *,
        title: str,
        size: tuple[float, float],
        width_ratios: tuple[float, float],
    ):
        self.time, label = time_axis(snapshot.plant, len(snapshot.record.actions))
        self.unit = label.removeprefix("time [").removesuffix("]")
        named = f"{title}, episode {last_episode(snapshot)}"
        self.figure, axes = panels(traces, 2, title=named, size=size, width_ratios=width_ratios)
        grid = axes[0, 0].get_gridspec()
        for ax in axes[:, 0]:
            ax.remove()
        self.ax = self.figure.add_subplot(grid[:, 0])
        self.caption = MovingCaption(self.ax)
        self.beside, self.traces, self.own = list(axes[:, 1]), list[Trace](), list[Artist]()
        for ax in self.beside[:-1]:
            ax.tick_params(labelbottom=False)
        self.beside[-1].set_xlabel(label)

    @property
    def moving(self) -> list[Artist]:
        """What :meth:`show` moves."""
        return [*self.own, *self.caption.moving, *(artist for trace in self.traces for artist in trace.moving)]
