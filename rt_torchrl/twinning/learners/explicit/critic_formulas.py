"""The formulas of critics for each transition, which torch computes or which become machine code."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

Layer = tuple[Tensor, Tensor]
"""Weights (out, in) and biases (out) of an affine map."""


@dataclass(frozen=True)
class CriticShape:
    """Numbers of a perceptron q(x) of SiLU layers.

    Args:
        n_o: number of observations.
        n_a: number of actions.
        hidden: widths of the hidden layers.
    """

    n_o: int
    n_a: int
    hidden: tuple[int, ...]

    @property
    def n_x(self) -> int:
        """Number of inputs."""
        return self.n_o + self.n_a

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Numbers of outputs and inputs of every affine map."""
        return [(n_out, n_in) for n_in, n_out in pairwise((self.n_x, *self.hidden, 1))]

    @property
    def n_w(self) -> int:
        """Number of weights and biases."""
        return sum(n_out * (n_in + 1) for n_out, n_in in self.sizes)

    def layers(self, weights: Float[Tensor, " n_w"]) -> list[Layer]:
        """The affine maps of weights and biases in turn."""
        parts = iter(weights.split([count for n_out, n_in in self.sizes for count in (n_out * n_in, n_out)]))
        return [(next(parts).view(n_out, n_in), next(parts)) for n_out, n_in in self.sizes]


def value_of(layers: Sequence[Layer], x: Float[Tensor, "n n_x"]) -> Float[Tensor, "n 1"]:
    """The value q(x)."""
    for weight, bias in layers[:-1]:
        z = torch.addmm(bias, x, weight.t())
        x = z * torch.sigmoid(z)
    return torch.addmm(layers[-1][1], x, layers[-1][0].t())


def derivatives_of(layers: Sequence[Layer], x: Float[Tensor, "n n_x"]) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    r"""The value, the outputs h_l of all hidden layers, and the slopes dq/dx and dq/dz_l.

    .. math::
        z_l = W_l h_{l-1} + b_l, \qquad h_l = z_l\sigma(z_l), \qquad
        \frac{dq}{dz_l} = h_l'(z_l) \odot W_{l+1}^\top\frac{dq}{dz_{l+1}}, \qquad h' = \sigma + h (1 - \sigma)

    SiLU and its derivative share one exponential.
    """
    hidden, rates = [], []
    for weight, bias in layers[:-1]:
        z = torch.addmm(bias, x, weight.t())
        share = torch.sigmoid(z)
        x = z * share
        hidden.append(x)
        rates.append(share + x * (1.0 - share))
    value = torch.addmm(layers[-1][1], x, layers[-1][0].t())
    slopes = [torch.ones_like(value)]
    for l in reversed(range(len(layers))):
        slope = slopes[0].mm(layers[l][0])
        if l:
            slope = slope * rates[l - 1]
        slopes.insert(0, slope)
    return value, hidden, slopes[:-1]


@dataclass(frozen=True)
class TemporalDifferences:
    r"""The formula of a critic iteration for critics i, of which the targets take the least.

    .. math::
        \delta_i = q_i(x) - r - \gamma\min_j q_j'(x'), \qquad g_i = 2 w\delta_i

    A row holds x, x', r, γ and w; weights are those of all critics and then of their targets. The results of a row are,
    for each critic in turn, δ, g, h_l of all hidden layers, and g dq/dz_l.

    Args:
        shape: numbers of each critic.
        members: number of critics.
    """

    shape: CriticShape
    members: int

    @property
    def n_in(self) -> int:
        """Length of a row."""
        return 2 * self.shape.n_x + 3

    @property
    def sizes(self) -> list[int]:
        """Lengths of the results."""
        return [1, 1, *self.shape.hidden, *self.shape.hidden] * self.members

    def __call__(self, rows: Float[Tensor, "n n_in"], weights: Float[Tensor, " n_w"]) -> list[Tensor]:
        n_x = self.shape.n_x
        x, following, reward, discount, share = rows.split([n_x, n_x, 1, 1, 1], -1)
        critics = [self.shape.layers(part) for part in weights.split(self.shape.n_w)]
        values = [value_of(target, following) for target in critics[self.members :]]
        goal = reward + discount * reduce(torch.minimum, values)
        found: list[Tensor] = []
        for critic in critics[: self.members]:
            value, hidden, slopes = derivatives_of(critic, x)
            error = value - goal
            scale = 2.0 * share * error
            found += [error, scale, *hidden, *(scale * slope for slope in slopes[1:])]
        return found


@dataclass(frozen=True)
class Ascent:
    r"""The formula of a policy iteration: w q(x), and −w dq/da by the scaled actions.

    A row holds x and w.

    Args:
        shape: numbers of the critic.
    """

    shape: CriticShape

    @property
    def n_in(self) -> int:
        """Length of a row."""
        return self.shape.n_x + 1

    @property
    def sizes(self) -> list[int]:
        """Lengths of the results."""
        return [1, self.shape.n_a]

    def __call__(self, rows: Float[Tensor, "n n_in"], weights: Float[Tensor, " n_w"]) -> list[Tensor]:
        x, share = rows.split([self.shape.n_x, 1], -1)
        value, _, slopes = derivatives_of(self.shape.layers(weights[: self.shape.n_w]), x)
        return [share * value, -share * slopes[0][:, self.shape.n_o :]]
