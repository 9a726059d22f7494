r"""Closures of the flapping wing for lift and drag of a blade element: a law, and a perceptron beside it."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.plants.closures import CorrectedLaw, PositiveCoefficients


class QuasiSteadyPolar(PositiveCoefficients):
    r"""Lift and drag coefficients of a blade element, eqs. (drone_eq_Clift) and (drone_eq_Cdrag) of the paper.

    .. math::
        C_L = a\sin2\alpha_e = 2a\sin\alpha_e\cos\alpha_e, \qquad
        C_D = b + c\,(1 - \cos2\alpha_e) = b + 2c\sin^2\alpha_e

    with the effective angle of attack :math:`\alpha_e` between the chord and the velocity of the element relative to
    the air. The features are its sine and cosine, the components of the direction of that velocity across and along the
    chord, so that no angle is computed. Any other polar of the two features, such as a perceptron, can replace the law.

    The true a, b and c are those of a semi-elliptical wing, which the paper takes from Lee et al. 2016.

    Note: the paper takes :math:`\alpha_e` from an arc cosine, which has no sign, and no slope at 0 and 180 deg; here
    its sine keeps the sign of the flow across the chord, so that the lift turns with the side that the air comes from.

    Args:
        coefficients: a, b, c [-], all positive.

    Raises:
        ValueError: if there are not three positive, finite coefficients.
    """

    names = {"a": "-", "b": "-", "c": "-"}
    meanings = {"a": "C_L at 45 deg", "b": "C_D at 0 deg", "c": "C_D at 45 deg, less b"}
    true_coefficients = (1.71, 0.043, 1.595)

    @classmethod
    def draw(cls, generator: torch.Generator) -> "QuasiSteadyPolar":
        """A guess whose coefficients each miss the true ones by a factor uniform on [1/2, 3/2]."""
        like: dict[str, Any] = {"dtype": torch.float64, "device": generator.device}
        factor = 1.0 + 0.5 * (2.0 * torch.rand(3, generator=generator, **like) - 1.0)
        return cls(torch.tensor(cls.true_coefficients, **like) * factor)

    def forward(self, features: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """C_L and C_D [-] at (sin α_e, cos α_e) = (U_ξ, U_ζ)/|U|."""
        sine, cosine = features.unbind(-1)
        a, b, c = self.coefficients.unbind()
        return torch.stack([2.0 * a * sine * cosine, b + 2.0 * c * sine**2], -1)


class NeuralPolar(CorrectedLaw):
    r"""Lift and drag of a blade element with two equal sides, by a perceptron.

    .. math::
        C_L = C_L^{QS}(\alpha_e) + 2\sin\alpha_e\,\tanh N_L(\cos\alpha_e), \qquad
        C_D = C_D^{QS}(\alpha_e)\,e^{\tanh N_D(\cos\alpha_e)}

    with the quasi-steady law QS as the start, which is trained too. A flow from the other side, α_e → −α_e, turns the
    lift and leaves the drag. A flow along the chord gives no lift. The drag is positive.
    """

    ranges = ((-1.0, 1.0),)  # cos α_e
    bounds = (2.0, 1.0)

    def forward(self, features: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """C_L and C_D [-] at (sin α_e, cos α_e)."""
        sine, cosine = features[..., :1], features[..., 1:]
        C_L, C_D = self.law(features).split(1, -1)
        lift, drag = self.correction(cosine).split(1, -1)
        return torch.cat([C_L + sine * lift, C_D * torch.exp(drag)], -1)
