"""The gradient check of a run's start."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from torch import nn

from rt_torchrl.evaluation.gradient_check import engine_gap
from rt_torchrl.evaluation.unseen import UnseenEpisodes


class TwoParts(nn.Module):
    """A closure with a part that can be frozen."""

    def __init__(self, plant):
        super().__init__()
        self.held, self.trained = plant.make_closure(torch.Generator()), plant.make_closure(torch.Generator())

    def forward(self, features):
        return 0.5 * (self.held(features) + self.trained(features))


@pytest.mark.parametrize("held", ["held", "held and trained"])
def test_weights_that_are_frozen_are_left_out(held):
    plant = LinearQuadratic()
    closure, policy = TwoParts(plant), plant.make_policy(torch.Generator().manual_seed(0))
    for part in held.split(" and "):
        getattr(closure, part).requires_grad_(False)
    # The continuous adjoint differs by the order of its step: 1e-4 for 0.1 s times the 1/120 of the local error.
    assert 0.0 < engine_gap(plant, closure, policy, UnseenEpisodes(plant, 2)) < 1e-5
    policy.requires_grad_(False)
    closure.requires_grad_(False)
    with pytest.raises(ValueError, match="closure TwoParts and policy LinearGain have no weight that is trained"):
        engine_gap(plant, closure, policy, UnseenEpisodes(plant, 2))
