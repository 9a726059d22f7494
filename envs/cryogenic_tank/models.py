r"""Closure of the tank, its three heat-transfer and valve constants, and the paper's policy for the vent."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.policies import SmoothClip
from rt_torchrl.signal import Signal

NAMES = ("U_s", "U_HX", "K_JT")
TRUE_COEFFICIENTS = (50.0, 75.0, 500e9)
"""U_s, U_HX [W/(m² K)] and K_JT [Pa s²/kg²] of the real tank (paper, section 5.3)."""
FIRST_GUESS = (1.0, 1.0, 10e9)
"""Where the paper's twin starts, w_p⁰ = [1, 1, 10], in the same units."""


class ConstantCoefficients(nn.Module):
    r"""Wall-to-fluid and heat-exchanger coefficients and the valve's constant, the same in every state.

    The trained weights are log U_s, log U_HX and log K_JT: they differ by a factor of 10¹⁰, have to travel a factor of
    50 and stay positive; a step in the logarithm is the same percentage of each.

    Any module that maps the four features of :meth:`CryogenicTank.features` to three positive coefficients, such as a
    perceptron with exponentials at its end, can stand in.

    Args:
        coefficients: U_s, U_HX [W/(m² K)] and K_JT [Pa s²/kg²], all positive.

    Raises:
        ValueError: if there are not three positive, finite coefficients.
    """

    def __init__(self, coefficients: Float[Tensor, " n"]):
        super().__init__()
        coefficients = torch.as_tensor(coefficients, dtype=torch.float64)
        if coefficients.shape != (3,) or not (coefficients.isfinite() & (coefficients > 0.0)).all():
            raise ValueError(
                f"coefficients={coefficients.tolist()} must be U_s, U_HX [W/(m² K)] and K_JT [Pa s²/kg²], positive and "
                f"finite; the tank of the paper has {TRUE_COEFFICIENTS}."
            )
        self.log_coefficients = nn.Parameter(coefficients.log())

    @classmethod
    def true(cls) -> "ConstantCoefficients":
        """Those of the real tank; the weights are frozen, they are not what is learned."""
        return cls(torch.tensor(TRUE_COEFFICIENTS, dtype=torch.float64)).requires_grad_(False)

    @classmethod
    def first_guess(cls, device: torch.device | str = "cpu") -> "ConstantCoefficients":
        """Those the paper's twin starts from."""
        return cls(torch.tensor(FIRST_GUESS, dtype=torch.float64, device=device))

    @property
    def coefficients(self) -> Float[Tensor, "3"]:
        """U_s, U_HX [W/(m² K)] and K_JT [Pa s²/kg²]."""
        return self.log_coefficients.exp()

    def named_coefficients(self) -> dict[str, Tensor]:
        """U_s, U_HX and K_JT by name, in their own units."""
        return dict(zip(NAMES, self.coefficients.unbind(), strict=True))

    def forward(self, features: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
        """U_s, U_HX [W/(m² K)] and K_JT [Pa s²/kg²]; the features do not matter here."""
        return self.coefficients.expand(*features.shape[:-1], 3)


class CubicVentLaw(nn.Module):
    r"""The paper's policy, a cubic of the pressure error through the smooth clip.

    .. math:: \Delta p_V = \tfrac12\Delta p_{max}\big(\tanh(w_1e + w_2e^3 + w_3) + 1\big)

    The trained weights are what each term contributes at the error ℓ = 3 (30 kPa), w_1ℓ, w_2ℓ³ and w_3: of the same
    size for a good vent, where the gradient with respect to w_2 itself would be some ten times the others.

    Args:
        action: the pressure drop and its range.
        weight_scale: standard deviation of the initial weights; zero starts with the valve half open.
        generator: source of the initial weights.
    """

    reference_error = 3.0  # ℓ, in the unit of the observation

    def __init__(self, action: Signal, *, weight_scale: float = 0.3, generator: torch.Generator):
        super().__init__()
        first = torch.randn(3, generator=generator, dtype=torch.float64, device=generator.device)
        self.scaled = nn.Parameter(weight_scale * first)
        self.clip = SmoothClip((action,))

    @property
    def weights(self) -> Float[Tensor, "3"]:
        """w_1, w_2 and w_3 of the formula."""
        linear, cubic, offset = self.scaled.unbind()
        return torch.stack([linear / self.reference_error, cubic / self.reference_error**3, offset])

    def forward(self, observation: Float[Tensor, "*batch 1"]) -> Float[Tensor, "*batch 1"]:
        """Pressure drop Δp_V [Pa] at the pressure error e."""
        share, linear, cubic, offset = observation / self.reference_error, *self.scaled.unbind()
        return self.clip(linear * share + cubic * share**3 + offset)
