"""The critics of a loss of TorchRL and their targets, with gradients by formula."""

import torch
from jaxtyping import Float
from torch import Tensor
from torchrl.objectives import LossModule

from rt_torchrl.twinning.learners.explicit.perceptron import Layer, Perceptron


class StackedCritics:
    """One critic, or several whose weights TorchRL keeps stacked; the weights stay where they are.

    Args:
        loss: loss with critics of the class :class:`Critic` and with targets of them.
        name: name of the critics' weights in the loss.
    """

    def __init__(self, loss: LossModule, name: str):
        named = {key: weight for key, weight in loss.named_parameters() if key.startswith(f"{name}.")}
        held = dict(loss.named_buffers())
        self.weights = list(named.values())
        self._targets = [held[f"target_{key}"] for key in named]
        self._flat = torch.cat([torch.zeros_like(weight).flatten() for weight in self.weights])
        parts = self._flat.split([weight.numel() for weight in self.weights])
        self.gradients = [part.view(weight.shape) for part, weight in zip(parts, self.weights, strict=True)]
        self._values = [weight.detach() for weight in self.weights]
        self.members = [Perceptron(layers) for layers in layers_of(self._values)]
        self.targets = [Perceptron(layers) for layers in layers_of(self._targets)]
        self._layers = layers_of(self.gradients)
        self.n_inputs = self.weights[0].shape[-1]

    @property
    def gradient_norm(self) -> Tensor:
        """Norm of the gradient that :meth:`learn` has found."""
        return torch.linalg.vector_norm(self._flat)

    def learn(
        self, x: Float[Tensor, "n n_x"], target: Float[Tensor, " n"], share: Float[Tensor, " n"]
    ) -> tuple[Tensor, Float[Tensor, " n"]]:
        """Write the gradients of the loss Σ_i Σ_k w_k (q_i(x_k) − y_k)² of all critics i.

        Args:
            x: observations and scaled actions.
            target: targets y.
            share: weights w.

        Returns:
            The loss, and the greatest |δ| of all critics for each row.
        """
        losses, errors = [], []
        for critic, out in zip(self.members, self._layers, strict=True):
            error = critic.forward(x).squeeze(-1).sub_(target)
            slope = error * share
            losses.append(torch.dot(slope, error))
            critic.weight_gradients(slope.mul_(2.0).unsqueeze(-1), out)
            errors.append(error.abs_())
        if len(errors) == 1:
            return losses[0], errors[0]
        return torch.stack(losses).sum(), torch.stack(errors).amax(0)

    def climb(
        self, x: Float[Tensor, "n n_x"], share: Float[Tensor, " n"], first: int
    ) -> tuple[Tensor, Float[Tensor, "n n_some"]]:
        """The mean value of the first critic, and the slope of its negative.

        Args:
            x: observations and scaled actions.
            share: weight of each row in the mean.
            first: number of the first input whose slope is wanted.
        """
        value = torch.dot(self.members[0].forward(x).squeeze(-1), share)
        return value, self.members[0].input_gradient(share.neg().unsqueeze(-1), first)

    def follow(self, rate: float) -> None:
        """Let the targets follow at a rate."""
        torch._foreach_lerp_(self._targets, self._values, rate)


def layers_of(weights: list[Tensor]) -> list[list[Layer]]:
    """Layers of each critic, from weights and biases in turn that may be stacked."""
    if weights[0].dim() == 2:
        return [list(zip(weights[::2], weights[1::2], strict=True))]
    return [[(w[k], b[k]) for w, b in zip(weights[::2], weights[1::2], strict=True)] for k in range(len(weights[0]))]
