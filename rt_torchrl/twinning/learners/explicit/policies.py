"""Policies as the iterations of step 2 see them: actions, and the gradient of what depends on the actions."""

from collections.abc import Callable, Sequence
from typing import Protocol, cast, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from rt_torchrl.plants.policies import SaturatedAffine, SaturatedMLP

Layer = tuple[Tensor, Tensor | None]
"""Weights (out, in) and biases (out) of an affine map; no biases if None."""


class Perceptron:
    r"""The formulas of a perceptron and of its gradients, with the weights of somebody else.

    .. math::
        z_l = W_l h_{l-1} + b_l, \qquad h_l = f(z_l), \qquad h_0 = x, \qquad y = W_L h_{L-1} + b_L

    .. math::
        \frac{dJ}{dW_l} = \sum_k g_{l,k} h_{l-1,k}^\top, \qquad \frac{dJ}{db_l} = \sum_k g_{l,k}, \qquad
        g_{l-1} = f'(z_{l-1}) \odot W_l^\top g_l, \qquad g_L = \frac{dJ}{dy}

    Gradients are those of the last batch that :meth:`forward` has seen.

    Args:
        layers: weights and biases of every affine map, from the first to the last; they are read anew in each call.
        activation: the function f, ``nn.SiLU`` or ``nn.Tanh``; it is not used if there is one layer.
    """

    def __init__(self, layers: Sequence[Layer], activation: type[nn.Module] = nn.SiLU):
        self.layers = list(layers)
        self._function, self._slope = FORMULAS[activation]

    def __call__(self, x: Float[Tensor, "n n_in"]) -> Float[Tensor, "n n_out"]:
        """The output y, of which no gradients are wanted."""
        for weight, bias in self.layers[:-1]:
            x = self._function(functional.linear(x, weight, bias))
        return functional.linear(x, *self.layers[-1])

    def forward(self, x: Float[Tensor, "n n_in"]) -> Float[Tensor, "n n_out"]:
        """The output y, of which :meth:`weight_gradients` gives gradients."""
        self._inputs, self._linear = [x], list[Tensor]()
        for weight, bias in self.layers[:-1]:
            z = functional.linear(x, weight, bias)
            x = self._function(z)
            self._linear.append(z)
            self._inputs.append(x)
        return functional.linear(x, *self.layers[-1])

    def weight_gradients(self, slope: Float[Tensor, "n n_out"], out: Sequence[Layer]) -> None:
        """Write dJ/dW and dJ/db of every layer.

        Args:
            slope: dJ/dy of each row.
            out: tensors of the shapes of ``layers`` that take the gradients.
        """
        for l in reversed(range(len(self.layers))):
            weight, bias = out[l]
            torch.mm(slope.t(), self._inputs[l], out=weight)
            if bias is not None:
                torch.sum(slope, 0, out=bias)
            if l:
                slope = self._slope(slope.mm(self.layers[l][0]), self._linear[l - 1], self._inputs[l])


def silu_slope(g: Tensor, z: Tensor, h: Tensor) -> Tensor:
    """See :data:`Slope`."""
    return torch.ops.aten.silu_backward(g, z)


def tanh_slope(g: Tensor, z: Tensor, h: Tensor) -> Tensor:
    """See :data:`Slope`."""
    return torch.ops.aten.tanh_backward(g, h)


Slope = Callable[[Tensor, Tensor, Tensor], Tensor]
"""The product g · f′(z), from g, z and h = f(z)."""
FORMULAS: dict[type[nn.Module], tuple[Callable[[Tensor], Tensor], Slope]] = {
    nn.SiLU: (functional.silu, silu_slope),
    nn.Tanh: (torch.tanh, tanh_slope),
}


def activation_of(network: nn.Module) -> type[nn.Module] | None:
    """The activation of a network as :func:`rt_torchrl.plants.policies.mlp` makes it; None for another form."""
    if type(network) is not nn.Sequential or len(network) % 2 == 0:
        return None
    linear, between = list(network)[::2], {type(module) for module in list(network)[1::2]} or {nn.Tanh}
    (activation, *others) = between
    fits = not others and activation in FORMULAS and all(type(module) is nn.Linear for module in linear)
    return activation if fits else None


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
