r"""Closures of the turbine's twin: a law for the power coefficient, alone or with a perceptron."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.wind_turbine.rotor import DATA, csv_rows
from rt_torchrl.plants.closures import CorrectedLaw

MEANINGS = {
    "c1": "factor of the exponential term of C_p",
    "c2": "factor of 1/ξ in the exponential term",
    "c3": "factor of β in the exponential term",
    "c4": "factor of ξβ in the exponential term",
    "c5": "factor of β^x in the exponential term",
    "c6": "constant in the exponential term",
    "c7": "factor of 1/ξ in the exponent",
    "c8": "factor of λ in C_p",
    "c9": "factor of β in 1/ξ",
    "c10": "factor of 1/(β³ + 1) in 1/ξ",
    "x": "exponent of β",
}
NAMES = tuple(MEANINGS)


class SaintDrenan(nn.Module):
    r"""Power coefficient of Saint-Drenan et al. 2020, eq. (c_p_correlation) of the paper.

    .. math::
        C_p = c_1\Big(\frac{c_2}{\xi} - c_3\beta - c_4\xi\beta - c_5\beta^x - c_6\Big)e^{-c_7/\xi} + c_8\lambda, \qquad
        \frac1\xi = \frac1{\lambda + c_9\beta} - \frac{c_{10}}{\beta^3 + 1}

    with β in degrees. c1 only scales c2 ... c6 and is not trained. The trained weights are the other coefficients
    divided by their typical sizes, which differ by 10⁴. The exponent is trained as log((x − 1)/0.5), so that x stays
    above 1.

    Note: the paper's last term is c8·ξ, its exponent is c12, and it has a c11; here they are c8·λ and x, because with
    c8·ξ the published sets peak at the wrong height, and no c11 appears in any source. Note: the law computes β^x as
    (β² + 0.01²)^{x/2}, because β^x has no slope at β = 0.

    Args:
        coefficients: c1 ... c10 and x, in the order of ``NAMES``.

    Raises:
        ValueError: if there are not eleven finite coefficients, or x is not above 1, where C_p has no slope at β = 0.
    """

    # Typical sizes of c1 ... c10: steps of this size change C_p by some hundredths near the optimum.
    scales = (0.1, 10.0, 0.1, 0.01, 0.01, 1.0, 2.0, 0.01, 0.05, 0.01)
    smallest_pitch = 0.01  # ε [deg]
    # In 1/ξ the law adds numbers and β in degrees, so that the units of the other coefficients are those of the fit.
    names = dict.fromkeys(NAMES, "-") | {"c3": "1/deg", "c4": "1/deg", "c5": "1/deg^x", "c9": "1/deg"}
    meanings = MEANINGS

    def __init__(self, coefficients: Float[Tensor, "11"]):
        super().__init__()
        coefficients = torch.as_tensor(coefficients, dtype=torch.float64)
        if coefficients.shape != (11,) or not coefficients.isfinite().all() or not coefficients[-1] > 1.0:
            raise ValueError(
                f"coefficients={coefficients.tolist()} must be 11 finite numbers, {', '.join(NAMES)}, with x above 1."
            )
        self.scale = nn.Buffer(torch.tensor(self.scales, dtype=torch.float64))
        scaled = torch.cat([coefficients[:-1] / self.scale, torch.log((coefficients[-1:] - 1.0) / 0.5)])
        self.fixed = nn.Buffer(scaled[:1].clone())
        self.scaled = nn.Parameter(scaled[1:].clone())

    @classmethod
    def from_set(cls, name: str) -> "SaintDrenan":
        """A law with a published set of coefficients; c5 = 0 becomes c5 = 1e-3 with x = 1.5, or neither could move.

        Raises:
            ValueError: if there is no set of that name.
        """
        header, *rows = csv_rows(DATA / "saint_drenan_2020_cp_sets.csv")
        sets = {row[0]: dict(zip(header, row, strict=True)) for row in rows}
        if name not in sets:
            raise ValueError(f"set {name!r} of coefficients does not exist; choose one of {', '.join(sets)}.")
        coefficients = {key: float(sets[name][key]) for key in NAMES}
        if coefficients["c5"] == 0.0:
            coefficients |= {"c5": 1e-3, "x": 1.5}
        return cls(torch.tensor(list(coefficients.values()), dtype=torch.float64))

    @property
    def coefficients(self) -> Float[Tensor, "11"]:
        """c1 ... c10 and x in their own units."""
        weights = torch.cat([self.fixed, self.scaled])
        return torch.cat([weights[:-1] * self.scale, 1.0 + 0.5 * weights[-1:].exp()])

    def named_coefficients(self) -> dict[str, Tensor]:
        """c1 ... c10 and x by name, in their own units."""
        return dict(zip(NAMES, self.coefficients.unbind(), strict=True))

    def forward(self, features: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 1"]:
        """C_p [-] at tip-speed ratio λ [-] and pitch β [deg]."""
        lam, beta = features[..., 0], features[..., 1]
        c1, c2, c3, c4, c5, c6, c7, c8, c9, c10, x = self.coefficients.unbind()
        inverse_xi = 1.0 / (lam + c9 * beta) - c10 / (beta**3 + 1.0)
        power = (beta**2 + self.smallest_pitch**2) ** (0.5 * x)
        bracket = c2 * inverse_xi - c3 * beta - c4 * beta / inverse_xi - c5 * power - c6
        return (c1 * bracket * torch.exp(-c7 * inverse_xi) + c8 * lam).unsqueeze(-1)


class NeuralPowerCoefficient(CorrectedLaw):
    r"""Saint-Drenan's law plus a perceptron for what the law cannot express; both are trained.

    .. math:: C_p(\lambda, \beta) = C_p^{SD}(\lambda, \beta) + \tfrac12\tanh N(\lambda, \beta)

    The closure starts as the law alone. The perceptron takes λ and β on the scales of the rotor's table. Far from the
    visited points it adds at most 0.5 to the law.
    """

    ranges = ((2.0, 14.0), (0.0, 25.0))  # λ [-] and β [deg]
    bounds = (0.5,)

    def forward(self, features: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 1"]:
        """C_p [-] at tip-speed ratio λ [-] and pitch β [deg]."""
        correction: Tensor = self.correction(features)
        return self.law(features) + correction
