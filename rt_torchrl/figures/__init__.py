"""Figures of a training, each from a :class:`Snapshot`, for any plant."""

from matplotlib.figure import Figure

from rt_torchrl.figures.episode import actions, exogenous, states
from rt_torchrl.figures.learning import closure_weights, learning_curves, seconds, tracked_weights
from rt_torchrl.figures.policy import policy_contours
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.unseen import unseen

__all__ = [
    "actions",
    "closure_weights",
    "exogenous",
    "figures_of",
    "learning_curves",
    "policy_contours",
    "seconds",
    "states",
    "unseen",
]


def figures_of(snapshot: Snapshot) -> dict[str, Figure]:
    """Every figure of this package there is something to show in, by name.

    Left out: ``exogenous`` and ``closure_weights`` in an arm that trains no twin, ``exogenous`` also on a plant without
    inputs, ``closure_weights`` also if no episode reports coefficients by name, ``learning_curves`` before the first
    episode is reported, ``seconds`` if no episode reports them.
    """
    twin = snapshot.large_scale is not None
    chosen = [states, actions, policy_contours]
    chosen += [exogenous] if twin and snapshot.plant.inputs else []
    chosen += [closure_weights] if twin and tracked_weights(snapshot.episodes) else []
    chosen += [learning_curves] if snapshot.episodes else []
    chosen += [seconds] if any(episode.get("seconds") for episode in snapshot.episodes) else []
    return {figure.__name__: figure(snapshot) for figure in chosen}
