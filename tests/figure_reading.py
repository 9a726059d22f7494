"""Common parts of the tests of figures: a snapshot without a training, and readings of a drawn figure."""

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


def line(ax, label):
    """The line with this label."""
    return next(line for line in ax.lines if line.get_label() == label)


def panel(figure, caption):
    """The axes whose caption begins so."""
    return next(ax for ax in figure.axes if ax.get_title(loc="left").startswith(caption))
