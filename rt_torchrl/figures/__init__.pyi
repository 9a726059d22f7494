"""The figures of a training; ``__init__.py`` imports each at its first use, from the module named here."""

from .episode import actions, exogenous, states
from .flights import flights
from .learning import closure_weights, learning_curves, seconds
from .overview import figures_of
from .policy import policy_contours
from .snapshot import Snapshot
from .style import pixels, save_figure, save_pixels
from .unseen_episodes import unseen

__all__ = [
    "Snapshot",
    "actions",
    "closure_weights",
    "exogenous",
    "figures_of",
    "flights",
    "learning_curves",
    "pixels",
    "policy_contours",
    "save_figure",
    "save_pixels",
    "seconds",
    "states",
    "unseen",
]
