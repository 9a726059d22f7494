r"""A Gaussian prior of a closure's weights, which holds what no record shows at its first value.

.. math:: \tfrac12\sum_i\Lambda_i(w_i - w_i^0)^2
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from rt_torchrl.optimisers.levenberg_marquardt import NormalEquations
from rt_torchrl.plants.closures import BoundedPerceptron


class WeightPrior:
    """The prior of the weights of a closure's perceptrons (:class:`BoundedPerceptron`), centred on the present ones.

    Other weights, such as constants of the physics, are free.

    Args:
        closure: closure with the weights.
        stiffness: factor Λ of all weights of perceptrons.
        device: device for a closure without trained weights.
    """

    def __init__(self, closure: nn.Module, stiffness: float, *, device: torch.device | str = "cpu"):
        self.closure, self.stiffness, self._device = closure, stiffness, device
        self.start = self.weights().detach().clone()
        held = {id(w) for m in closure.modules() if isinstance(m, BoundedPerceptron) for w in m.parameters()}
        trained = [w for w in closure.parameters() if w.requires_grad]
        each = [torch.full_like(w.detach().flatten(), float(id(w) in held)) for w in trained]
        self.held = torch.cat(each) if each else self.start

    def weights(self) -> Tensor:
        """The trained weights in one vector."""
        trained = [w.flatten() for w in self.closure.parameters() if w.requires_grad]
        return torch.cat(trained) if trained else torch.empty(0, dtype=torch.float64, device=self._device)

    def cost(self) -> Tensor:
        """The cost, differentiable by the weights."""
        return 0.5 * self.stiffness * (self.held * (self.weights() - self.start).square()).sum()

    def determined(self, inverse: Tensor) -> Tensor:
        """Number of weights that the prior determines instead of the data, by the inverse of the information."""
        n = len(self.start)
        return (self.stiffness * self.held * inverse.diagonal()[:n]).sum()

    def added(self, found: NormalEquations) -> NormalEquations:
        """Normal equations, whose first unknowns are the weights, with the prior."""
        if not self.stiffness:
            return found
        rest = len(found.gradient) - len(self.start)
        each = self.stiffness * self.held
        pull = pad(each * (self.weights() - self.start), (0, rest))
        matrix = found.matrix + torch.diag(pad(each, (0, rest)))
        return NormalEquations(found.cost + self.cost(), found.gradient + pull, matrix)


class Belief(NamedTuple):
    """What is believed of a closure's trained weights: their mean and covariance."""

    mean: Float[Tensor, " n_w"]
    covariance: Float[Tensor, "n_w n_w"]


class BeliefPrior(WeightPrior):
    r"""The prior of weights that drift, from what was believed of them before.

    .. math:: \tfrac12(w - \bar w)^\top(C + q^2I)^{-1}(w - \bar w)

    Args:
        closure: closure with the weights.
        belief: mean and covariance of the weights before.
        drift: standard deviation q by which each weight may have changed since.

    Raises:
        ValueError: if the drift is not positive and finite, or the belief is of other weights.
    """

    def __init__(self, closure: nn.Module, belief: Belief, drift: float):
        super().__init__(closure, 1.0)
        if not 0.0 < drift < float("inf"):
            raise ValueError(f"drift={drift} of the weights must be positive and finite.")
        if belief.mean.shape != self.start.shape:
            raise ValueError(f"the belief is of {len(belief.mean)} weights; the closure has {len(self.start)}.")
        self.start = belief.mean
        unit = torch.eye(len(belief.mean), dtype=belief.mean.dtype, device=belief.mean.device)
        self.precision = torch.linalg.inv(belief.covariance + drift**2 * unit)
        self.held = torch.zeros_like(belief.mean)  # nothing that the data could make stiffer

    def cost(self) -> Tensor:
        """The cost, differentiable by the weights."""
        change = self.weights() - self.start
        return 0.5 * change @ self.precision @ change

    def determined(self, inverse: Tensor) -> Tensor:
        """Number of weights that the belief determines instead of the data."""
        n = len(self.start)
        return (self.precision * inverse[:n, :n]).sum()

    def added(self, found: NormalEquations) -> NormalEquations:
        """Normal equations, whose first unknowns are the weights, with the prior."""
        n = len(self.start)
        gradient, matrix = found.gradient.clone(), found.matrix.clone()
        gradient[:n] += self.precision @ (self.weights() - self.start)
        matrix[:n, :n] += self.precision
        return NormalEquations(found.cost + self.cost(), gradient, matrix)
