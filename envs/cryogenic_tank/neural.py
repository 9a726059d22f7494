r"""Closure of the tank with a perceptron."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.cryogenic_tank.models import ConstantCoefficients
from rt_torchrl.plants.closures import BoundedPerceptron
from rt_torchrl.plants.plant import Plant


class NeuralCoefficients(nn.Module):
    r"""Coefficients that depend on the state, each a constant times a factor between 1/2 and 2.

    .. math:: (U_s, U_{HX}, K_{JT})_i = C_i\,2^{\tanh N_i(x)}

    with the features x of :meth:`CryogenicTank.features`. Both the logarithms of the constants and the perceptron are
    trained: the first guess is wrong by factors of fifty, and the dependence on the state is far weaker.

    Args:
        constants: constants C that the closure starts from.
        hidden: width of each hidden layer.
        generator: source of the perceptron's initial weights.
    """

    ranges = ((0.8, 1.2), (0.6, 0.75), (0.0, 2.0), (0.0, 1.0))  # p/p̃, V_l/V_t, (T_s − T)/0.05 K, Δp_V/Δp_max

    def __init__(self, constants: ConstantCoefficients, *, hidden: Sequence[int], generator: torch.Generator):
        super().__init__()
        self.constants = constants
        self.correction = BoundedPerceptron(self.ranges, (1.0,) * 3, hidden=hidden, generator=generator)

    def forward(self, features: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
        """U_s, U_HX [W/(m² K)] and K_JT [Pa s²/kg²]."""
        return self.constants(features) * torch.exp2(self.correction(features))


def first_neural_guess(plant: Plant, generator: torch.Generator, hidden: Sequence[int]) -> NeuralCoefficients:
    """A neural closure that starts at the paper's first guess, U_s = U_HX = 1 W/(m² K) and K_JT = 10 GPa s²/kg²."""
    constants = ConstantCoefficients.first_guess(generator.device)
    return NeuralCoefficients(constants, hidden=hidden, generator=generator)
