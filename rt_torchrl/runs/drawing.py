"""The figures of a run, on the dashboard and in its folder."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from torch import nn

from rt_torchrl import figures
from rt_torchrl.evaluation.unseen import Baseline, UnseenEpisodes
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.steps.config import Role

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # only its type: runs load Matplotlib when they draw

PlantFigures = Callable[[Snapshot], dict[str, "Figure"]]


class Drawing:
    """Draws the figures of a run, each once.

    Args:
        plant_figures: function that draws the figures that only this plant has.
        animate: function that writes an animation of the last real episode to a path.
    """

    def __init__(self, plant_figures: PlantFigures, animate: Callable[[Snapshot, Path], None] | None):
        self.plant_figures, self.animate = plant_figures, animate

    def drawn(self, snapshot: Snapshot) -> dict[str, "Figure"]:
        """The figures of a training."""
        return figures.figures_of(snapshot) | self.plant_figures(snapshot)

    def images(self, snapshot: Snapshot) -> dict[str, np.ndarray]:
        """Pixels of the figures of a training, by name."""
        return {name: figures.pixels(figure) for name, figure in self.drawn(snapshot).items()}

    def save(
        self, snapshot: Snapshot, folder: Path, *, first: Mapping[str, "Figure"], last: Mapping[str, "Figure"]
    ) -> dict[str, np.ndarray]:
        """Write the figures and the animation at the end of a run.

        Args:
            snapshot: the training at its end.
            folder: folder of the figures.
            first: figures before those of the training, by name.
            last: figures after them.

        Returns:
            Pixels of all figures.
        """
        folder.mkdir(exist_ok=True)
        drawn = {**first, **self.drawn(snapshot), **last}
        images = {name: figures.pixels(figure) for name, figure in drawn.items()}
        for name, image in images.items():
            figures.save_pixels(image, folder / f"{name}.png")
        if self.animate:
            self.animate(snapshot, folder / "animation.gif")
        return images


def first_flights(
    unseen: UnseenEpisodes, live: Role, policy: nn.Module, baselines: Mapping[str, Baseline]
) -> dict[str, "Figure"]:
    """The figure of the first unseen episode under the live policy and the classical controllers.

    It is left out on a real system of unknown closure, where these would be flights of their own.
    """
    if unseen.closure is None:
        return {}
    episode = unseen.first(1)
    flown = {str(live): episode.fly(policy)}
    flown |= {name: episode.fly_baseline(law) for name, law in baselines.items()}
    return {"flights": figures.flights(unseen.physics, {who: one.each()[0] for who, one in flown.items()})}
