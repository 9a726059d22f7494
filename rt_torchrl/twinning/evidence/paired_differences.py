r"""How wrong the twin is about a policy, learned from the real episodes of it and of its neighbours.

The twin flies each real episode again with the same weights from the same state under the same inputs, so that luck
cancels. What is left is the paired difference :math:`d_i = \log J_i - \log\hat J_i`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.twinning.evidence.alarm import BEYOND_CHANCE

COMMON = 0.1
"""Standard deviation of an error that all policies share, of log J."""
LOCAL = 0.5
"""Standard deviation of an error that a policy shares with its neighbours alone."""
NOISE = 0.05
"""Standard deviation of d for one episode: exploration, and what the replay does not repeat."""
REACH = 0.1
"""Distance of policies, as an RMS difference of their actions in shares of the ranges, at which they are neighbours."""
EXPLORED = 2.0
"""Standard deviation of d for each unit of exploration."""
LARGEST = 5.0
"""Greatest |d| that counts: beyond e⁵ = 150 times it does not matter how wrong a prediction is."""

LEAST = -1.0
"""Least d of a twin that is merely wrong. One that says more than e times the real cost blows up or stalls where the
real system does not, and need not do so with the neighbours of a policy."""


class Belief(NamedTuple):
    """Mean and standard deviation of log J_real − log J_twin of a policy."""

    mean: float
    deviation: float


class PairedDifferences:
    r"""A Gaussian process of d over policies, whose distance is that of their actions.

    .. math:: k(\pi, \pi') = \sigma_c^2 + \sigma_l^2\exp\big(-\tfrac12\|a_\pi - a_{\pi'}\|^2/\ell^2\big)

    Here a_π are the actions of a policy in some observations of the real system, in shares of their ranges, and the
    norm is the root mean square. Without episodes the belief is zero with the prior's deviation.

    Args:
        actions: actions of the policies of past episodes in the same observations.
        differences: d of these episodes.
        exploration: exploration of these episodes, as a share of half the ranges, which the twin does not repeat.
        least: least d that counts; a smaller one is taken for it.

    Raises:
        ValueError: if the numbers of policies, differences and explorations differ.
    """

    def __init__(
        self,
        actions: Float[Tensor, "n m"],
        differences: Float[Tensor, " n_d"],
        exploration: Float[Tensor, " n_e"] | None = None,
        least: float = -LARGEST,
    ):
        exploration = torch.zeros_like(differences) if exploration is None else exploration
        if not len(actions) == len(differences) == len(exploration):
            raise ValueError(
                f"{len(actions)} policies, {len(differences)} differences and {len(exploration)} explorations must be "
                "as many."
            )
        self.actions = actions.detach()
        self.differences = differences.detach().clamp(least, LARGEST)
        self.exploration = exploration
        covariance = self._kernel(self.actions) + torch.diag(NOISE**2 + (EXPLORED * exploration) ** 2)
        self._root = torch.linalg.cholesky(covariance)
        self._weights = torch.cholesky_solve(self.differences.unsqueeze(-1), self._root)

    def at_least(self, least: float) -> "PairedDifferences":
        """What follows from the same episodes, where a smaller d is taken for ``least``."""
        return PairedDifferences(self.actions, self.differences, self.exploration, least)

    def of(self, differences: Sequence[float]) -> "PairedDifferences":
        """What follows if these are the differences of the same episodes."""
        values = self.differences.new_tensor(differences)
        return PairedDifferences(self.actions, values, self.exploration)

    def _kernel(self, others: Float[Tensor, "k m"]) -> Float[Tensor, "k n"]:
        squared = (others.unsqueeze(1) - self.actions).square().mean(-1)
        return COMMON**2 + LOCAL**2 * torch.exp(-0.5 * squared / REACH**2)

    def posterior(self, actions: Float[Tensor, " m"]) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Mean and standard deviation of d of a policy with these actions, differentiable."""
        prior = actions.new_tensor(COMMON**2 + LOCAL**2)
        if not len(self.differences):
            return actions.new_zeros(()), prior.sqrt()
        k = self._kernel(actions.unsqueeze(0))
        half = torch.linalg.solve_triangular(self._root, k.mT, upper=False)
        variance = (prior - half.square().sum()).clamp_min(NOISE**2 / len(self.differences))
        return (k @ self._weights).squeeze(), variance.sqrt()

    def deviation_between(self, one: Float[Tensor, " m"], other: Float[Tensor, " m"]) -> float:
        r"""Standard deviation of d(π) − d(π'), whose errors are those of neighbours: zero for policies that act alike.

        .. math:: \sigma^2 = k_{\pi\pi} + k_{\pi'\pi'} - 2 k_{\pi\pi'} - (k_\pi - k_{\pi'})^T K^{-1} (k_\pi - k_{\pi'})
        """
        apart = -torch.expm1(-0.5 * (one - other).square().mean() / REACH**2)
        variance = 2.0 * LOCAL**2 * apart
        if len(self.differences):
            seen = self._kernel(one.unsqueeze(0)) - self._kernel(other.unsqueeze(0))
            variance = variance - torch.linalg.solve_triangular(self._root, seen.mT, upper=False).square().sum()
        return variance.clamp_min(0.0).sqrt().item()  # rounding alone makes it negative

    def belief(self, actions: Float[Tensor, " m"]) -> Belief:
        """The same as numbers."""
        mean, deviation = self.posterior(actions)
        return Belief(mean.item(), deviation.item())


def difference(real: float, predicted: float) -> float:
    """The paired difference d of an episode, within ±LARGEST; LARGEST if the twin diverges, although nothing did.

    Costs above zero have a ratio; of others, as of a perfect one, the difference is taken as zero.
    """
    if not math.isfinite(predicted):
        return LARGEST
    if not (real > 0.0 and predicted > 0.0):
        return 0.0
    return max(-LARGEST, min(LARGEST, math.log(real / predicted)))


def unexplained(value: float, exploration: float) -> float:
    """Size of a paired difference beyond what exploration explains."""
    return abs(value) - 2.0 * EXPLORED * exploration


def excess(value: float, exploration: float) -> float:
    """How far beyond chance an episode cost more than the twin says, by its paired difference; else not above zero."""
    return unexplained(value, exploration) - BEYOND_CHANCE if value > 0.0 else 0.0
