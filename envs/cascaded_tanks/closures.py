r"""Closures of the cascaded tanks: pump, outlets and overflow, and a perceptron beside them."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.closures import CorrectedLaw, PositiveCoefficients


class Hydraulics(PositiveCoefficients):
    r"""Flows of pump, outlets and overflow, as rates of the levels.

    .. math::
        q_0 = ku, \qquad q_1 = b_1h_1, \qquad q_2 = a_2\sqrt{h_2} - b_2h_2, \qquad
        q_o = c\,w\ln\big(1 + e^{(h_1 - \ell)/w}\big)

    The upper tank drains through a tube, with a flow in proportion to its level; the lower one through an orifice with
    losses. Of the overflow q_o of the upper tank, the share e reaches the lower tank.

    Args:
        coefficients: the coefficients in the order of ``names``, all positive.

    Raises:
        ValueError: if there are not six positive, finite coefficients.
    """

    names = {
        "pump": "1/s",
        "upper_outlet": "1/s",
        "lower_outlet": "V^0.5/s",
        "lower_loss": "1/s",
        "overflow_level": "V",
        "overflow_share": "-",
    }
    meanings = {
        "pump": "rise of the upper level for a volt at the pump",
        "upper_outlet": "flow of the upper outlet over its level",
        "lower_outlet": "flow of the lower outlet over the root of its level",
        "lower_loss": "loss of this flow over its level",
        "overflow_level": "upper level from which water overflows",
        "overflow_share": "share of the overflow that reaches the lower tank",
    }
    true_coefficients = (0.06, 0.0062, 0.096, 0.0098, 28.0, 0.65)
    overflow_rate = 0.25
    """Rate c [1/s] of the overflow for each volt above its level; the hard edge of a tank would be infinite."""
    overflow_band = 0.1
    """Width w [V] over which the overflow sets in."""

    def flows(self, features: Float[Tensor, "*batch 3"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Flows [V/s] of pump, upper outlet, lower outlet and overflow."""
        upper, lower, voltage = features.unbind(-1)
        pump, upper_outlet, lower_outlet, lower_loss, level, _ = self.coefficients.unbind()
        # √h, rounded off within a hundredth of a volt of zero, where its slope would be infinite.
        root = lower / (lower**2 + 1e-4) ** 0.25
        over = self.overflow_rate * ramp(upper - level, self.overflow_band)
        return pump * voltage, upper_outlet * upper, lower_outlet * root - lower_loss * lower, over

    def forward(self, features: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Rates of the levels [V/s] at upper level, lower level and pump voltage [V]."""
        pumped, down, out, over = self.flows(features)
        return torch.stack([pumped - down - over, down + self.coefficients[-1] * over - out], -1)


class NeuralHydraulics(CorrectedLaw):
    r"""Hydraulics with a perceptron that corrects both outlets and what reaches the lower tank of the overflow.

    .. math:: \dot h_1 = q_0 - q_1 - q_o - N_1, \qquad \dot h_2 = q_1 + eq_o - q_2 + N_1 - N_2

    N_1 and N_2 are functions of both levels and the voltage. They are zero at first.
    """

    law: Hydraulics

    ranges = ((0.0, 30.0), (0.0, 10.0), (0.0, 7.0))
    bounds = (0.03, 0.03)
    """Greatest corrections of a flow [V/s], about a sixth of the mean flow."""

    def named_coefficients(self) -> dict[str, Tensor]:
        """The coefficients of the law by name; the perceptron's weights mean nothing by themselves."""
        return self.law.named_coefficients()

    def forward(self, features: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Rates of the levels [V/s] at upper level, lower level and pump voltage [V]."""
        down, out = self.correction(features).unbind(-1)
        return self.law(features) + torch.stack([-down, down - out], -1)


def ramp(x: Tensor, band: float) -> Tensor:
    """The smooth ramp w ln(1 + exp(x/w)) of width w, ``band``."""
    return band * nn.functional.softplus(x / band)
