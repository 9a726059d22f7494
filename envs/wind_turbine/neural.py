r"""Closure of the turbine's twin with a perceptron."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.wind_turbine.models import SaintDrenan
from rt_torchrl.plants.closures import BoundedPerceptron


class NeuralPowerCoefficient(nn.Module):
    r"""Saint-Drenan's law plus a perceptron for what the law cannot express; both are trained.

    .. math:: C_p(\lambda, \beta) = C_p^{SD}(\lambda, \beta) + \tfrac12\tanh N(\lambda, \beta)

    The closure starts as the law alone. The perceptron takes λ and β on the scales of the rotor's table. Far from the
    visited points it adds at most 0.5 to the law.

    Args:
        law: law that the closure starts from.
        hidden: width of each hidden layer.
        generator: source of the perceptron's initial weights.
    """

    ranges = ((2.0, 14.0), (0.0, 25.0))  # λ [-] and β [deg]
    bound = 0.5

    def __init__(self, law: SaintDrenan, *, hidden: Sequence[int], generator: torch.Generator):
        super().__init__()
        self.law = law
        self.correction = BoundedPerceptron(self.ranges, (self.bound,), hidden=hidden, generator=generator)

    def forward(self, features: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 1"]:
        """C_p [-] at tip-speed ratio λ [-] and pitch β [deg]."""
        return self.law(features) + self.correction(features)
