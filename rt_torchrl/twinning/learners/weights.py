"""Weights of a policy: copies, means and steps between them."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

Weights = dict[str, Tensor]


def weights_of(policy: nn.Module) -> Weights:
    """A copy of the weights of a policy, by name."""
    return {name: weight.detach().clone() for name, weight in policy.state_dict().items()}


class MeanWeights:
    """The mean of a policy's weights over some iterations.

    A policy circles around its best weights at a distance that its learning rate sets; the mean lies nearer to them.

    Args:
        policy: the policy.
    """

    def __init__(self, policy: nn.Module):
        self._weights = [weight.detach() for weight in policy.parameters() if weight.requires_grad]
        self._mean: list[Tensor] = []
        self._count = 0

    def add(self, counts: bool) -> None:
        """Add the present weights, if this iteration counts."""
        if not counts:
            return
        self._count += 1
        if self._mean:
            torch._foreach_lerp_(self._mean, self._weights, 1.0 / self._count)
        else:
            self._mean = [weight.clone() for weight in self._weights]

    def install(self) -> None:
        """Give the policy the mean, if there is one."""
        for weight, mean in zip(self._weights, self._mean, strict=bool(self._mean)):
            weight.copy_(mean)


def step_towards(policy: nn.Module, first: Weights, last: Weights, share: float) -> None:
    """Give a policy the weights that are this share of the way from the first ones to the last ones."""
    policy.load_state_dict({name: first[name] + share * (last[name] - first[name]) for name in last})


@torch.no_grad()
def change_of_actions(
    policy: nn.Module, earlier: Weights, seen: Float[Tensor, "n n_o"], half_range: Float[Tensor, " n_a"]
) -> float:
    """RMS change of a policy's actions since it had earlier weights, as a share of half their range.

    Args:
        policy: the policy.
        earlier: the earlier weights.
        seen: observations in which actions are compared.
        half_range: half the range of each action.
    """
    now, present = policy(seen), weights_of(policy)
    try:
        policy.load_state_dict(earlier)
        change = (now - policy(seen)) / half_range
    finally:
        policy.load_state_dict(present)
    return change.square().mean().sqrt().item()
