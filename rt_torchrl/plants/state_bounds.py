"""Bounds on the states of a plant, and by how much trajectories leave them."""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.plants.plant import Plant

OUTSIDE = " outside [%]"
"""End of the name of how often a state is outside."""


class StateBounds:
    """Least and greatest values of some states that sensors read.

    Args:
        plant: plant that gives the states.
        states: least and greatest value of each bounded state, by name, in its unit; infinite for no bound.

    Raises:
        ValueError: if the plant has no such state.
    """

    def __init__(self, plant: Plant, states: Mapping[str, tuple[float, float]]):
        places = {signal.name: k for k, signal in enumerate(plant.readings)}
        unknown = sorted(set(states) - set(places))
        if unknown:
            raise ValueError(f"bounded states {', '.join(unknown)} do not exist; the plant has {', '.join(places)}.")
        self.names = list(states)
        self._places = [places[name] for name in self.names]
        self._units = [plant.states[place].unit for place in self._places]
        self._low, self._high = ([states[name][end] for name in self.names] for end in (0, 1))
        self._widths = [_width(*states[name]) for name in self.names]

    def __bool__(self) -> bool:
        """Whether there is any bound."""
        return bool(self.names)

    def beyond(self, states: Float[Tensor, "*batch n_s"]) -> list[Float[Tensor, "*batch n_b"]]:
        """How far each bounded state lies below its least and above its greatest value, in shares of the width.

        The width is that between the bounds or, with one bound, its size. Within the bounds both are negative.
        """
        seen, widths = states[..., self._places], states.new_tensor(self._widths)
        return [(states.new_tensor(self._low) - seen) / widths, (seen - states.new_tensor(self._high)) / widths]

    def shares(self, states: Float[Tensor, "*batch n_s"]) -> Float[Tensor, "*batch n_b"]:
        """How far each bounded state lies outside, in shares of the width; zero within the bounds."""
        return sum((torch.relu(side) for side in self.beyond(states)), start=torch.zeros_like(states[..., :1]))

    def merit(self, states: Float[Tensor, "batch samples n_s"]) -> dict[str, Float[Tensor, " batch"]]:
        """How often each state is beyond its bounds, and how far at most, in each of some episodes."""
        found: dict[str, Tensor] = {}
        outside = self.shares(states[:, 1:]).unbind(-1)
        for name, unit, width, share in zip(self.names, self._units, self._widths, outside, strict=True):
            found[f"{name}{OUTSIDE}"] = 100.0 * (share > 0.0).double().mean(-1)
            found[f"{name} beyond [{unit}]"] = width * share.amax(-1)
        return found


def _width(low: float, high: float) -> float:
    """The size by which an excess is measured."""
    if math.isfinite(high - low):
        return high - low
    return next((abs(end) for end in (low, high) if math.isfinite(end) and end), 1.0)
