"""What happens to a plant within a decision, whatever it is commanded, and is not known when the decision begins."""

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

RIDGE = 1e-6
"""Share of the features' variance that is added to it, because some features repeat others."""
LEAST_SHARE = 1e-6
"""Least standard deviation of an innovation as a share of the input's; one that varies less is foretold."""


class Innovations:
    r"""Innovations of the exogenous inputs z within a decision of m control intervals that begins at k.

    .. math::
        \omega_k = \frac{y_k - M(1, x_k)}{\sigma}, \qquad
        y_k = \Big(z_{k+m},\ \tfrac1m\sum_{1\le j\le m}z_{k+j}\Big)

    M is the linear law that foretells y from the features x at best over the memory, and σ the standard deviation of
    what is left. For m = 1 the mean is left out. An innovation says nothing of the action, so that a critic that sees
    it explains by it what else would be noise beside the small effect of one action.

    Args:
        starts: features of decisions at their beginnings, with mean zero and variance one.
        inputs: y of the same decisions, as :func:`inputs_within` gives them.
    """

    def __init__(self, starts: Float[Tensor, "n n_x"], inputs: Float[Tensor, "n n_y"]):
        known = with_one(starts)
        square = known.t() @ known / len(known)
        square = square + RIDGE * torch.eye(len(square), dtype=square.dtype, device=square.device)
        self._law = torch.linalg.solve(square, known.t() @ inputs / len(known))
        left, spread = (inputs - known @ self._law).std(0), inputs.std(0)
        varies = left > LEAST_SHARE * (spread + inputs.mean(0).abs())
        self._rate = torch.where(varies, 1.0 / left, 0.0)

    def __call__(self, starts: Float[Tensor, "n n_x"], inputs: Float[Tensor, "n n_y"]) -> Float[Tensor, "n n_y"]:
        """Innovations ω of decisions."""
        return (inputs - with_one(starts) @ self._law) * self._rate


def with_one(x: Float[Tensor, "n n_x"]) -> Float[Tensor, "n n_known"]:
    """The rows with a constant one."""
    return torch.cat([x, torch.ones_like(x[:, :1])], -1)


def inputs_within(episode: TensorDictBase, at: Tensor, intervals: int) -> Float[Tensor, "n n_y"]:
    """The inputs y of decisions that begin at some control intervals; beyond an episode the last input stays.

    Args:
        episode: real episode with the entry ``exogenous``.
        at: control intervals.
        intervals: number m of control intervals of a decision.
    """
    exogenous = episode["exogenous"]
    ahead = at.unsqueeze(-1) + torch.arange(1, intervals + 1, device=at.device)
    within = exogenous[ahead.clamp(max=len(exogenous) - 1)]
    return within[:, 0] if intervals == 1 else torch.cat([within[:, -1], within.mean(1)], -1)


def count_innovations(n_inputs: int, intervals: int) -> int:
    """Number of innovations of a decision."""
    return n_inputs * min(intervals, 2)
