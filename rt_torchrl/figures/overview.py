"""All figures of a training that any plant has."""

from matplotlib.figure import Figure

from rt_torchrl.figures.episode import actions, exogenous, states
from rt_torchrl.figures.learning import closure_weights, learning_curves, seconds, tracked_weights
from rt_torchrl.figures.policy import policy_contours
from rt_torchrl.figures.snapshot import Snapshot


def figures_of(snapshot: Snapshot) -> dict[str, Figure]:
    """Figures of this room by name, but that of the unseen episodes; a figure with nothing to show is left out.

    ``exogenous`` needs an arm that trains a twin, and a plant with inputs. ``closure_weights`` needs an arm that trains
    a twin, and episodes that report coefficients by name. ``learning_curves`` needs a reported episode, and
    ``seconds`` an episode that reports them.
    """
    twin = snapshot.large_scale is not None
    chosen = [states, actions, policy_contours]
    chosen += [exogenous] if twin and snapshot.plant.inputs else []
    chosen += [closure_weights] if twin and tracked_weights(snapshot.episodes) else []
    chosen += [learning_curves] if snapshot.episodes else []
    chosen += [seconds] if any(episode.get("seconds") for episode in snapshot.episodes) else []
    return {figure.__name__: figure(snapshot) for figure in chosen}
