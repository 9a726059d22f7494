"""Common parts of the tests of figures: a snapshot without a training, and readings of a drawn figure."""

from itertools import combinations

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from rt_torchrl import Rollout, Snapshot, Trajectory


def snapshot_of(plant, twin, *, shift, realisations=True, episodes=()) -> Snapshot:
    """One episode of a plant and its replay by a twin; d̃ is the exogenous input shifted by ``shift``."""
    generator = torch.Generator().manual_seed(0)
    policies = {role: plant.make_policy(generator) for role in ("model_based", "model_free")}
    start, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    with torch.no_grad():
        flown = Rollout(plant, plant.closure, policies["model_based"])(start, exogenous)
        replayed = Rollout(plant, twin)(start, exogenous, flown.actions)
    return Snapshot(
        plant=plant,
        true_closure=plant.closure,
        closure=twin,
        initial_closure=plant.make_closure(generator),
        policies=policies,
        live="model_based",
        record=Trajectory(flown.states[0], flown.actions[0], exogenous[0]),
        replay=replayed.states[0],
        segment=0,
        large_scale=exogenous[0] + shift,
        realisations=exogenous if realisations else None,
        episodes=list(episodes),
    )


def draw(figure) -> set[str]:
    """Draw a figure, which raises on broken mathtext, and return every text in it."""
    FigureCanvasAgg(figure).draw()
    return {text.get_text() for text in figure.findobj(Text)}


def clipped_texts(figure) -> list[str]:
    """Titles and axis labels that stick out of the canvas of a drawn figure."""
    texts = [figure._suptitle]
    for ax in figure.axes:
        texts += [ax._left_title, ax._right_title, ax.xaxis.label, ax.yaxis.label]
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts if text.get_text()]
    width, height = figure.bbox.size
    return [name for name, b in boxes if b.x0 < 0 or b.y0 < 0 or b.x1 > width or b.y1 > height]


def collisions(figure) -> list[tuple[str, str]]:
    """Pairs of titles, ticks along x and legends of a drawn figure that lie on each other."""
    boxes = []
    for ax in figure.axes:
        first, last = sorted(ax.get_xlim())
        # A tick beyond the ends has a label too, which is not drawn.
        ticks = [text for text in ax.get_xticklabels() if first <= text.get_position()[0] <= last]
        texts = [ax._left_title, ax._right_title, *ticks]
        boxes += [
            (text.get_text(), text.get_window_extent()) for text in texts if text.get_text() and text.get_visible()
        ]
        boxes += [("legend", ax.get_legend().get_window_extent())] if ax.get_legend() else []
    return [(one, other) for (one, first), (other, second) in combinations(boxes, 2) if first.overlaps(second)]


def line(ax, label):
    """The line with this label."""
    return next(line for line in ax.lines if line.get_label() == label)


def panel(figure, caption):
    """The axes whose caption begins so."""
    return next(ax for ax in figure.axes if ax.get_title(loc="left").startswith(caption))
