"""A perceptron whose gradients are written out, because autograd costs more than the products of small matrices."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

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
