"""Coefficients of an actuator's dynamics."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.plants.closures import PositiveCoefficients


class ActuatorCoefficients(PositiveCoefficients):
    """Positive coefficients of one extension, named after what it acts on, so that nested extensions differ.

    Args:
        names: unit of each coefficient, by name.
        meanings: what each coefficient is, by name.
        values: the coefficients.

    Raises:
        ValueError: if a coefficient is not positive and finite.
    """

    def __init__(self, names: dict[str, str], meanings: dict[str, str], values: Sequence[float]):
        for name, value in zip(names, values, strict=True):
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name}={value} {names[name]} must be positive and finite.")
        self.names, self.meanings, self.true_coefficients = dict(names), dict(meanings), tuple(values)
        super().__init__(torch.tensor(values, dtype=torch.float64))

    def forward(self) -> Float[Tensor, " n"]:
        """The coefficients."""
        return self.coefficients
