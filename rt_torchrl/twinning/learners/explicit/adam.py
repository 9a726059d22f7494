"""Steps of Adam without the checks that ``torch.optim.Adam.step`` repeats in each of them."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

Moments = tuple[list[Tensor], list[Tensor], list[Tensor]]
ORDINARY = {"amsgrad": False, "maximize": False, "capturable": False, "differentiable": False}


class AdamSteps:
    """The steps of an optimiser, with its rates and its state, which stay where they are.

    On the CPU one fused kernel takes the step. On another device, with another optimiser or with unusual options, the
    optimiser takes it itself, as it does for the first one, which makes its state.

    Args:
        optimiser: optimiser of the weights.
    """

    def __init__(self, optimiser: torch.optim.Optimizer):
        self._optimiser = optimiser
        self._weights: list[torch.nn.Parameter] = []
        self._moments: Moments | None = None
        self._rates: dict[str, Any] = {}

    def step(self, weights: list[torch.nn.Parameter], gradients: list[Tensor]) -> None:
        """Change weights by their gradients.

        Args:
            weights: weights of the optimiser; those that are left out are not changed.
            gradients: gradient of each of them.
        """
        if weights is not self._weights:
            self._take(weights)
        if self._moments is None:
            self._ordinary_step(gradients)
            self._take(weights)
            return
        first, second, steps = self._moments
        self._count.add_(1.0)
        torch._fused_adam_(self._values, gradients, first, second, [], steps, **self._rates)

    def _take(self, weights: list[torch.nn.Parameter]) -> None:
        self._weights, self._moments = weights, moments(self._optimiser, weights)
        self._values = [weight.detach() for weight in weights]
        group = self._optimiser.param_groups[0]
        if self._moments is not None:
            beta1, beta2 = group["betas"]
            self._rates = {"lr": group["lr"], "beta1": beta1, "beta2": beta2, "eps": group["eps"]}
            self._rates |= {"weight_decay": group["weight_decay"], "amsgrad": False, "maximize": False}
            # One addition counts the steps of all weights.
            self._count = torch.stack(self._moments[2])
            self._moments = (*self._moments[:2], list(self._count))
            for weight, steps in zip(weights, self._moments[2], strict=True):
                self._optimiser.state[weight]["step"] = steps

    def _ordinary_step(self, gradients: Sequence[Tensor]) -> None:
        self._optimiser.zero_grad(set_to_none=True)
        for weight, gradient in zip(self._weights, gradients, strict=True):
            weight.grad = gradient
        self._optimiser.step()


def moments(optimiser: torch.optim.Optimizer, weights: list[torch.nn.Parameter]) -> Moments | None:
    """Both moments and the numbers of steps of weights; None if the optimiser has to take the step itself."""
    if type(optimiser) is not torch.optim.Adam or len(optimiser.param_groups) != 1:
        return None
    (group,) = optimiser.param_groups
    ordinary = all(group[name] == value for name, value in ORDINARY.items())
    if not ordinary or any(weight.device.type != "cpu" or weight not in optimiser.state for weight in weights):
        return None
    first, second, steps = (
        [optimiser.state[weight][name] for weight in weights] for name in ("exp_avg", "exp_avg_sq", "step")
    )
    return first, second, steps
