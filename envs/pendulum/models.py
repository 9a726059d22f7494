r"""Closure of the pendulum: the effect of its mass and length."""

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.plants.closures import PositiveCoefficients


class UniformRod(PositiveCoefficients):
    r"""Mass and length of a uniform rod that turns about its end, with moment of inertia ml²/3.

    .. math:: c_g = \frac{mgl/2}{ml^2/3}\,\frac1g = \frac{3}{2l}, \qquad c_u = \frac{1}{ml^2/3} = \frac{3}{ml^2}

    The coefficients do not depend on the features. Another law for c_g and c_u, such as a perceptron that also learns
    friction, can replace this closure.

    Args:
        coefficients: mass m [kg] and length l [m], both positive.

    Raises:
        ValueError: if there are not two positive, finite coefficients.
    """

    names = {"mass": "kg", "length": "m"}
    meanings = {"mass": "mass of the rod", "length": "length of the rod"}
    true_coefficients = (1.0, 1.0)

    @classmethod
    def guess(cls, share: float) -> "UniformRod":
        """A rod whose mass and length are both ``share`` times the true ones.

        Raises:
            ValueError: if ``share`` is not positive and finite.
        """
        return cls(share * torch.tensor(cls.true_coefficients, dtype=torch.float64))

    def forward(self, features: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """c_g [1/m] and c_u [1/(kg m²)], the same at every (cos θ, sin θ, dθ/dt)."""
        mass, length = self.coefficients.unbind()
        coefficients = torch.stack([1.5 / length, 3.0 / (mass * length**2)])
        return coefficients.expand(*features.shape[:-1], 2)
