"""The critics of a loss of TorchRL and their targets, with gradients by formula."""

import torch
from jaxtyping import Float
from torch import Tensor
from torchrl.objectives import LossModule

from rt_torchrl.twinning.learners.explicit.critic_formulas import CriticShape, TemporalDifferences
from rt_torchrl.twinning.learners.explicit.row_function import RowFunction


class StackedCritics:
    """One critic, or several whose weights TorchRL keeps stacked; the weights stay where they are.

    Args:
        loss: loss with critics of the class :class:`Critic` and with targets of them.
        name: name of the critics' weights in the loss.
        n_a: number of actions.
        n: number of transitions in a batch.
    """

    def __init__(self, loss: LossModule, name: str, n_a: int, n: int):
        named = {key: weight for key, weight in loss.named_parameters() if key.startswith(f"{name}.")}
        held = dict(loss.named_buffers())
        self.weights = list(named.values())
        self._values = [weight.detach() for weight in self.weights]
        self._targets = [held[f"target_{key}"] for key in named]
        self._flat = torch.cat([torch.zeros_like(weight).flatten() for weight in self._values])
        parts = self._flat.split([weight.numel() for weight in self._values])
        self.gradients = [part.view(weight.shape) for part, weight in zip(parts, self._values, strict=True)]
        members = members_of(self._values)
        widths = [bias.numel() for bias in members[0][1::2]]
        self.shape = CriticShape(members[0][0].shape[1] - n_a, n_a, tuple(widths[:-1]))
        self._parts = [part.view(-1) for member in members + members_of(self._targets) for part in member]
        self._row, self._old = torch.cat(self._parts), False
        self._differences = RowFunction(TemporalDifferences(self.shape, len(members)), n, self._row)
        self.rows = self._differences.rows
        """Rows x, x', r, γ and w of a batch, to be written before :meth:`learn`."""
        self._plan(len(members))

    def _plan(self, count: int) -> None:
        """Name the parts of the results, and the products of them that the gradients are."""
        depth = len(self.shape.sizes)
        width, x = 2 * depth, self.rows[: self.shape.n_x]
        self._errors, self._scales, self._products = [], [], []
        for k, gradients in enumerate(members_of(self.gradients)):
            error, scale, *others = self._differences.results[k * width : (k + 1) * width]
            self._errors.append(error[0])
            self._scales.append(scale[0])
            inputs, slopes = [x, *others[: depth - 1]], [*others[depth - 1 :], scale]
            left = [part.t() for part in inputs]
            self._products += list(zip(slopes, left, gradients[::2], gradients[1::2], strict=True))

    @property
    def row(self) -> Float[Tensor, " n_w"]:
        """Present weights of all critics, and then those of their targets."""
        if self._old:
            torch.cat(self._parts, out=self._row)
            self._old = False
        return self._row

    @property
    def gradient_norm(self) -> Tensor:
        """Norm of the gradient that :meth:`learn` has found."""
        return torch.linalg.vector_norm(self._flat)

    def learn(self) -> tuple[Tensor, Float[Tensor, " n"]]:
        """Write the gradients of the loss Σ_i Σ_k w_k δ_ik² of all critics i, whose weights change afterwards.

        Returns:
            The loss, and the greatest |δ| of all critics for each row.
        """
        self._differences(self.row)
        self._old = True
        for slope, left, by_weight, by_bias in self._products:
            torch.mm(slope, left, out=by_weight)
            torch.sum(slope, 1, out=by_bias)
        losses = [0.5 * torch.dot(scale, error) for scale, error in zip(self._scales, self._errors, strict=True)]
        if len(losses) == 1:
            return losses[0], self._errors[0].abs()
        return torch.stack(losses).sum(), torch.stack(self._errors).abs_().amax(0)

    def follow(self, rate: float) -> None:
        """Let the targets follow at a rate."""
        self._old = True
        torch._foreach_lerp_(self._targets, self._values, rate)


def members_of(weights: list[Tensor]) -> list[list[Tensor]]:
    """Weights and biases of each critic, in turn, from those of all, which may be stacked."""
    if weights[0].dim() == 2:
        return [weights]
    return [[weight[k] for weight in weights] for k in range(len(weights[0]))]
