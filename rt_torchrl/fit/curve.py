r"""Pointwise intervals of what a closure says, such as a curve that a perceptron has learned.

The closure's weights scatter by their covariance C, and a value c(x; w) of the curve by

.. math:: \sigma_c^2(x) = \frac{\partial c}{\partial w}\,C\,\frac{\partial c}{\partial w}^\top

to first order (Laplace's approximation). With a prior of the weights, C is the inverse of the sum of the Fisher
information and the prior's stiffness, so that the interval widens where no data was, as far as the prior allows.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.fit.uncertainty import Uncertainty, normal_factor


class Band(NamedTuple):
    """A curve and its pointwise interval at the abscissae x."""

    x: Float[Tensor, " points"]
    middle: Float[Tensor, " points"]
    low: Float[Tensor, " points"]
    high: Float[Tensor, " points"]

    def covers(self, true: Float[Tensor, " points"]) -> float:
        """Share of the points at which the interval holds the true curve."""
        return ((true >= self.low) & (true <= self.high)).double().mean().item()


def scatter(
    closure: nn.Module, features: Float[Tensor, "points n_f"], uncertainty: Uncertainty
) -> tuple[Float[Tensor, "points n_c"], Float[Tensor, "points n_c"]]:
    """What a closure says of features, and the standard deviation of it; infinite where the data say nothing.

    Args:
        closure: the closure.
        features: features at which it is asked.
        uncertainty: uncertainty of the closure's trained weights, in the order of ``parameters()``.
    """
    trained = {name: w.detach() for name, w in closure.named_parameters() if w.requires_grad}

    def said(weights: dict[str, Tensor], x: Tensor) -> Tensor:
        found: Tensor = torch.func.functional_call(closure, weights, (x,))
        return found

    jacobians = torch.func.vmap(torch.func.jacrev(said), in_dims=(None, 0))(trained, features)
    J = torch.cat([jacobian.flatten(2) for jacobian in jacobians.values()], -1)
    variance = torch.einsum("pcw,wv,pcv->pc", J, uncertainty.weights_covariance, J)
    with torch.no_grad():
        return closure(features), torch.where(uncertainty.untold(J), torch.inf, variance.clamp_min(0.0).sqrt())


def band(
    uncertainty: Uncertainty,
    x: Float[Tensor, " points"],
    features: Float[Tensor, "points n_f"],
    *,
    output: int = 0,
    level: float = 0.95,
) -> Band:
    """The interval of one output of the estimated closure along a line of features.

    Args:
        uncertainty: uncertainty of the estimate.
        x: abscissae, one for each point.
        features: features of the closure at these points.
        output: number of the closure's output.
        level: probability of each point's interval.

    Raises:
        ValueError: if the level does not lie between 0 and 1.
    """
    closure = uncertainty.likelihood.twin.closure
    said, deviation = scatter(closure, features, uncertainty)
    half = normal_factor(level) * deviation[:, output]
    middle = said[:, output]
    return Band(x, middle, middle - half, middle + half)
