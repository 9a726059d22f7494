r"""A Gaussian prior of a closure's weights, which holds what no record shows at its first value.

.. math:: \tfrac12\sum_i\Lambda_i(w_i - w_i^0)^2
"""

import torch
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

    def added(self, found: NormalEquations) -> NormalEquations:
        """Normal equations, whose first unknowns are the weights, with the prior."""
        if not self.stiffness:
            return found
        rest = len(found.gradient) - len(self.start)
        each = self.stiffness * self.held
        pull = pad(each * (self.weights() - self.start), (0, rest))
        matrix = found.matrix + torch.diag(pad(each, (0, rest)))
        return NormalEquations(found.cost + self.cost(), found.gradient + pull, matrix)
