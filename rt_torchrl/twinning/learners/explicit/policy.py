"""Policies as the iterations of step 2 see them: actions, and the gradient of what depends on the actions."""

from typing import Protocol, cast, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.policies import SaturatedAffine, SaturatedMLP
from rt_torchrl.twinning.learners.explicit.perceptron import Layer, Perceptron, activation_of


@runtime_checkable
class DifferentiablePolicy(Protocol):
    """A policy with the gradients of its weights."""

    def __call__(self, observation: Float[Tensor, "n n_o"]) -> Float[Tensor, "n n_a"]:
        """Actions of which no gradients are wanted."""

    def forward(self, observation: Float[Tensor, "n n_o"]) -> Float[Tensor, "n n_a"]:
        """Actions of which :meth:`gradients` gives gradients."""

    def gradients(self, slope: Float[Tensor, "n n_a"]) -> tuple[list[nn.Parameter], list[Tensor]]:
        """Weights that the last batch depends on, and their gradients dJ/dw.

        Args:
            slope: dJ/da of each action of the last batch.
        """


class ExplicitPolicy:
    """The formulas of :class:`SaturatedAffine` and :class:`SaturatedMLP`, with the weights of the policy.

    Args:
        policy: policy of one of these two classes.
    """

    def __init__(self, policy: SaturatedAffine | SaturatedMLP):
        network = nn.Sequential(policy.linear) if isinstance(policy, SaturatedAffine) else policy.network
        linear = [module for module in network if isinstance(module, nn.Linear)]
        self._weights = [weight for module in linear for weight in module.parameters()]
        self._gradients = [torch.empty_like(weight) for weight in self._weights]
        self._perceptron = Perceptron(
            layers_of(linear, [w.detach() for w in self._weights]), activation_of(network) or nn.Tanh
        )
        self._layers = layers_of(linear, self._gradients)
        low, high = policy.clip.low, policy.clip.high
        self._middle, self._half = 0.5 * (high + low), 0.5 * (high - low)

    def __call__(self, observation: Float[Tensor, "n n_o"]) -> Float[Tensor, "n n_a"]:
        return torch.addcmul(self._middle, torch.tanh(self._perceptron(observation)), self._half)

    def forward(self, observation: Float[Tensor, "n n_o"]) -> Float[Tensor, "n n_a"]:
        self._share = torch.tanh(self._perceptron.forward(observation))
        return torch.addcmul(self._middle, self._share, self._half)

    def gradients(self, slope: Float[Tensor, "n n_a"]) -> tuple[list[nn.Parameter], list[Tensor]]:
        inner = torch.ops.aten.tanh_backward(slope * self._half, self._share)
        self._perceptron.weight_gradients(inner, self._layers)
        return self._weights, self._gradients


class AutogradPolicy:
    """Any other policy, of which autograd gives the gradients.

    Args:
        policy: policy ``policy(observation) -> action``.
    """

    def __init__(self, policy: nn.Module):
        self._policy = policy
        self._trainable = self._used = [weight for weight in policy.parameters() if weight.requires_grad]

    def __call__(self, observation: Float[Tensor, "n n_o"]) -> Float[Tensor, "n n_a"]:
        with torch.no_grad():
            return cast(Tensor, self._policy(observation))

    def forward(self, observation: Float[Tensor, "n n_o"]) -> Float[Tensor, "n n_a"]:
        with torch.enable_grad():
            self._action = self._policy(observation)
        return self._action.detach()

    def gradients(self, slope: Float[Tensor, "n n_a"]) -> tuple[list[nn.Parameter], list[Tensor]]:
        found = torch.autograd.grad(self._action, self._trainable, slope.to(self._action.dtype), allow_unused=True)
        gradients = [gradient for gradient in found if gradient is not None]
        if len(gradients) < len(found) or self._used is not self._trainable:
            # A list of its own for every batch, since another batch may use other weights.
            self._used = [w for w, gradient in zip(self._trainable, found, strict=True) if gradient is not None]
        return self._used, gradients


def differentiable(policy: nn.Module) -> DifferentiablePolicy:
    """A policy with the gradients of its weights, by formula if there is one."""
    if not all(weight.requires_grad for weight in policy.parameters()):
        return AutogradPolicy(policy)
    if not isinstance(policy, SaturatedAffine | SaturatedMLP) or type(policy) not in (SaturatedAffine, SaturatedMLP):
        return AutogradPolicy(policy)  # a subclass may compute its actions in another way
    known = isinstance(policy, SaturatedAffine) or activation_of(policy.network) is not None
    return ExplicitPolicy(policy) if known else AutogradPolicy(policy)


def layers_of(modules: list[nn.Linear], tensors: list[Tensor]) -> list[Layer]:
    """Layers of modules from the tensors that belong to their parameters, in the order of these."""
    left = iter(tensors)
    return [(next(left), None if module.bias is None else next(left)) for module in modules]
