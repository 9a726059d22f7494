"""A clone between two architectures, on the linear-quadratic plant."""

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from seeds_and_numbers import seeded
from test_algorithm import LEARNING, STEPS, flown, twinning, weights

from rt_torchrl import SaturatedAffine, SaturatedMLP
from rt_torchrl.steps.belief import Judged
from rt_torchrl.steps.config import RefereeConfig
from rt_torchrl.steps.report import same_architecture
from rt_torchrl.steps.switch import other_than

PLANT = LinearQuadratic(horizon=2.0)


def affine(*rows):
    policy = SaturatedAffine(2, PLANT.actions, generator=seeded(0))
    with torch.no_grad():
        policy.linear.weight.copy_(torch.tensor(rows))
    return policy


def perceptron(seed=1):
    return SaturatedMLP(2, PLANT.actions, hidden=(16, 16), generator=seeded(seed))


def two_architectures(**options):
    options = {"learner": LEARNING, "referee": RefereeConfig(clone_patience=0), **options}
    policies = {"model_free": perceptron(), "model_based": affine([-0.8, -1.1])}
    return twinning(PLANT, seed=9, closure=LinearClosure(PLANT.true_closure), **policies, **options)


@pytest.mark.parametrize("live", ["model_free", "model_based"])
def test_a_clone_event_distils(live):
    found = two_architectures()
    found.referee.live = live
    episode = flown(found, *STEPS[:-1])
    idle = other_than(live)
    before, replaced = weights(found.policies[live]), weights(found.policies[idle])
    judge, poor = found.belief.judge, found.policies[idle]

    def judged(policy, episodes):
        return Judged(1e9, 1e9) if policy is poor and torch.equal(weights(poor), replaced) else judge(policy, episodes)

    found.belief.judge = judged
    report = flown(found, "switch", episode=episode)
    assert report["event"] == "clone" and torch.equal(weights(found.policies[live]), before)
    assert 0.0 < report["distillation_error"] < 0.05
    # The clone costs what the live policy does, within what an action of 5 % of the range can change.
    assert report["distillation_cost_ratio"] == pytest.approx(1.0, rel=0.1)
    steps = found.learner.actor_adam.parts[0] if idle == "model_free" else found.planner._optimiser.state
    assert not steps


def test_a_refused_clone_is_no_event_and_says_why():
    found = two_architectures()
    found.referee.live = "model_based"
    episode = flown(found, *STEPS[:-1])
    before = {role: weights(policy) for role, policy in found.policies.items()}
    costs = iter([1e-9, 2e-9, 2e-9, 1.0])  # of both policies, of that which is replaced, of its clone
    found.belief.judge = lambda policy, episodes: Judged(cost := next(costs), cost)
    report = flown(found, "switch", episode=episode)
    assert report["event"] == "keep" and "clone refused" in report["reason"]
    assert all(torch.equal(before[role], weights(policy)) for role, policy in found.policies.items())
    assert found.referee.stall_count == 0


def test_a_copy_of_weights_is_no_clone_of_another_activation():
    """Weights have the same names and shapes but make other functions, so a copy of them is another policy."""

    def network(activation, generator_seed=0):
        torch.manual_seed(generator_seed)
        return torch.nn.Sequential(torch.nn.Linear(2, 4), activation, torch.nn.Linear(4, 1)).double()

    assert same_architecture(network(torch.nn.Tanh()), network(torch.nn.Tanh(), 1))
    assert not same_architecture(network(torch.nn.Tanh()), network(torch.nn.SiLU()))
    assert not same_architecture(network(torch.nn.LeakyReLU(0.1)), network(torch.nn.LeakyReLU(0.2)))

    class Scaled(torch.nn.Module):
        def __init__(self, factor):
            super().__init__()
            self.factor, self.layer = factor, torch.nn.Linear(2, 1)

    assert same_architecture(Scaled(1.0), Scaled(1.0)) and not same_architecture(Scaled(1.0), Scaled(2.0))
    ones, twos = np.ones(2), np.full(2, 2.0)
    assert same_architecture(Scaled(ones), Scaled(ones.copy())) and not same_architecture(Scaled(ones), Scaled(twos))
    assert not same_architecture(affine([-0.8, -1.1]), perceptron())
