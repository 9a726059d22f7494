"""Coefficients of an extension's dynamics."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extensions.extension import OwnParameters

RANGE = 30.0
"""Greatest factor by which a coefficient differs from the value that it begins with."""


class ActuatorCoefficients(OwnParameters):
    r"""Positive coefficients of one extension, :math:`c = c_0\,30^{\tanh w}` with the weights w.

    An identification cannot lose a coefficient: beyond a factor of 30 a record no longer shows it, and an unbounded
    search would go on to a lag of years. The coefficients are named after what they act on, so that nested extensions
    differ.

    Args:
        names: unit of each coefficient, by name.
        meanings: what each coefficient is, by name.
        values: the coefficients c_0.

    Raises:
        ValueError: if a coefficient is not positive and finite.
    """

    start: Tensor

    def __init__(self, names: dict[str, str], meanings: dict[str, str], values: Sequence[float]):
        super().__init__()
        for name, value in zip(names, values, strict=True):
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name}={value} {names[name]} must be positive and finite.")
        self.names, self.meanings = dict(names), dict(meanings)
        self.register_buffer("start", torch.tensor(values, dtype=torch.float64))
        self.weights = nn.Parameter(torch.zeros(len(names), dtype=torch.float64))

    def forward(self) -> Float[Tensor, " n"]:
        """The coefficients in the units of ``names``."""
        return self.start * torch.exp(math.log(RANGE) * torch.tanh(self.weights))

    def named_coefficients(self) -> dict[str, Tensor]:
        """The coefficients by name."""
        return dict(zip(self.names, self().unbind(), strict=True))

    def fresh(self) -> "ActuatorCoefficients":
        """The same coefficients with the values that they began with, to be trained."""
        return ActuatorCoefficients(self.names, self.meanings, self.start.tolist())
