r"""Closure of the flapping wing with a perceptron."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.flapping_wing.models import QuasiSteadyPolar
from rt_torchrl.plants.closures import BoundedPerceptron
from rt_torchrl.plants.plant import Plant


class NeuralPolar(nn.Module):
    r"""Lift and drag of a blade element with two equal sides, by a perceptron.

    .. math::
        C_L = C_L^{QS}(\alpha_e) + 2\sin\alpha_e\,\tanh N_L(\cos\alpha_e), \qquad
        C_D = C_D^{QS}(\alpha_e)\,e^{\tanh N_D(\cos\alpha_e)}

    with the quasi-steady law QS as the start, which is trained too. A flow from the other side, α_e → −α_e, turns the
    lift and leaves the drag. A flow along the chord gives no lift. The drag is positive.

    Args:
        law: quasi-steady law that the closure starts from.
        hidden: width of each hidden layer.
        generator: source of the perceptron's initial weights.
    """

    ranges = ((-1.0, 1.0),)  # cos α_e
    bounds = (2.0, 1.0)

    def __init__(self, law: QuasiSteadyPolar, *, hidden: Sequence[int], generator: torch.Generator):
        super().__init__()
        self.law = law
        self.correction = BoundedPerceptron(self.ranges, self.bounds, hidden=hidden, generator=generator)

    def forward(self, features: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """C_L and C_D [-] at (sin α_e, cos α_e)."""
        sine, cosine = features[..., :1], features[..., 1:]
        C_L, C_D = self.law(features).split(1, -1)
        lift, drag = self.correction(cosine).split(1, -1)
        return torch.cat([C_L + sine * lift, C_D * torch.exp(drag)], -1)


def drawn_neural_polar(plant: Plant, generator: torch.Generator, hidden: Sequence[int]) -> NeuralPolar:
    """A neural closure that starts at a draw of the paper's closure, within ±50 % of the true coefficients."""
    return NeuralPolar(QuasiSteadyPolar.draw(generator), hidden=hidden, generator=generator)
