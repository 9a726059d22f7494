"""The figures of a training; ``__init__.py`` imports each at its first use, from the module named here."""

from .comparison import flights, unseen
from .snapshot import Snapshot
from .style import pixels, save_figure, save_pixels
from .training import (
    closure_weights,
    exogenous,
    figures_of,
    learned_law,
    learning_curves,
    policy_contours,
    states,
)

__all__ = [
    "Snapshot",
    "closure_weights",
    "exogenous",
    "figures_of",
    "flights",
    "learned_law",
    "learning_curves",
    "pixels",
    "policy_contours",
    "save_figure",
    "save_pixels",
    "states",
    "unseen",
]
