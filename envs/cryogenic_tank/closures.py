r"""Closures of the tank, three constants and a perceptron beside them, and the paper's policy for the vent."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.closures import CorrectedLaw, PositiveCoefficients
from rt_torchrl.plants.policies import SmoothClip
from rt_torchrl.plants.signal import Signal


class ConstantCoefficients(PositiveCoefficients):
    r"""Wall-to-fluid and heat-exchanger coefficients and the valve's constant, the same in every state.

    The weights are logarithms, because the coefficients differ by a factor of 10¹⁰ and have to change by one of 50.

    Any module that maps the four features of :meth:`CryogenicTank.features` to three positive coefficients, such as a
    perceptron with exponentials at its end, can replace this closure.

    Args:
        coefficients: U_s, U_HX [W/(m² K)] and K_JT [Pa s²/kg²], all positive.

    Raises:
        ValueError: if there are not three positive, finite coefficients.
    """

    names = {"U_s": "W/(m² K)", "U_HX": "W/(m² K)", "K_JT": "Pa s²/kg²"}
    meanings = {
        "U_s": "heat transfer from wall to fluid",
        "U_HX": "heat transfer in the exchanger",
        "K_JT": "pressure drop of the valve over flow²",
    }
    true_coefficients = (50.0, 75.0, 500e9)  # paper, section 5.3
    guessed_coefficients = (1.0, 1.0, 10e9)  # where the paper's twin starts, w_p⁰ = [1, 1, 10]


class NeuralCoefficients(CorrectedLaw):
    r"""Coefficients that depend on the state, each a constant times a factor between 1/2 and 2.

    .. math:: (U_s, U_{HX}, K_{JT})_i = C_i\,2^{\tanh N_i(x)}

    with the features x of :meth:`CryogenicTank.features`. Both the logarithms of the constants and the perceptron are
    trained: the first guess is wrong by factors of fifty, and the dependence on the state is far weaker.
    """

    ranges = ((0.8, 1.2), (0.6, 0.75), (0.0, 2.0), (0.0, 1.0))  # p/p̃, V_l/V_t, (T_s − T)/0.05 K, Δp_V/Δp_max
    bounds = (1.0,) * 3

    def forward(self, features: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
        """U_s, U_HX [W/(m² K)] and K_JT [Pa s²/kg²]."""
        constants: Tensor = self.law(features)
        return constants * torch.exp2(self.correction(features))


class CubicVentLaw(nn.Module):
    r"""The paper's policy, a cubic of the pressure error through the smooth clip.

    .. math:: \Delta p_V = \tfrac12\Delta p_{max}\big(\tanh(w_1e + w_2e^3 + w_3) + 1\big)

    The trained weights are the contributions of the terms at the error ℓ = 3 (30 kPa), w_1ℓ, w_2ℓ³ and w_3. For a good
    vent these have the same size, while the gradient with respect to w_2 itself would be some ten times the others.

    Args:
        action: the pressure drop and its range.
        generator: source of the initial weights, whose standard deviation is 0.3; zero is a valve that is half open.
    """

    reference_error = 3.0  # ℓ, in the unit of the observation

    def __init__(self, action: Signal, *, generator: torch.Generator):
        super().__init__()
        first = torch.randn(3, generator=generator, dtype=torch.float64, device=generator.device)
        self.scaled = nn.Parameter(0.3 * first)
        self.clip = SmoothClip((action,), device=generator.device)

    @property
    def weights(self) -> Float[Tensor, "3"]:
        """w_1, w_2 and w_3 of the formula."""
        linear, cubic, offset = self.scaled.unbind()
        return torch.stack([linear / self.reference_error, cubic / self.reference_error**3, offset])

    def forward(self, observation: Float[Tensor, "*batch 1"]) -> Float[Tensor, "*batch 1"]:
        """Pressure drop Δp_V [Pa] at the pressure error e."""
        share, linear, cubic, offset = observation / self.reference_error, *self.scaled.unbind()
        return self.clip(linear * share + cubic * share**3 + offset)
