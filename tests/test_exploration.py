"""Exploration noise: deviation and correlation of what reaches the actuators, and a fresh start at each episode."""

import math

import pytest
import torch
from linear_quadratic import LinearQuadratic

from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy


class Held(torch.nn.Module):
    """A policy that always asks for the same action."""

    def __init__(self, action):
        super().__init__()
        self.action = action

    def forward(self, observation):
        return self.action


def noise(plant, n=40_000, *, strength=1.0, **options):
    """Actions that noise makes of a policy that asks for mid-range, as shares of half the range."""
    middle = torch.tensor([0.5 * (a.low + a.high) for a in plant.actions], dtype=torch.float64)
    config = ExplorationConfig(spread=0.1, **options)
    actor = LivePolicy(plant, Held(middle), config, generator=torch.Generator().manual_seed(0))
    actor.begin(actor.policy, strength=strength)
    observation = torch.zeros(len(plant.observations), dtype=torch.float64)
    acted = torch.stack([actor(observation) for _ in range(n)])
    half = torch.tensor([0.5 * (a.high - a.low) for a in plant.actions], dtype=torch.float64)
    return (acted - middle) / half


@pytest.mark.parametrize("intervals", [0.0, 3.0])
def test_deviation_and_correlation_are_those_asked_for(intervals):
    plant = LinearQuadratic()
    found = noise(plant, correlation_time=intervals * plant.dt, strength=0.5)
    rho = math.exp(-1.0 / intervals) if intervals else 0.0
    # Standard error of a deviation over 40 000 samples of which some 1 + 2ρ/(1 − ρ) count as one: 2 % at most.
    assert found.std(0).tolist() == pytest.approx([0.05] * len(plant.actions), rel=0.05)
    for lag in (1, 2, 5):
        correlation = (found[lag:] * found[:-lag]).mean(0) / found.square().mean(0)
        assert correlation.tolist() == pytest.approx([rho**lag] * len(plant.actions), abs=0.04)


def test_an_episode_does_not_begin_with_the_noise_of_the_last_one():
    plant = LinearQuadratic()
    config = ExplorationConfig(correlation_time=1e6 * plant.dt, spread=0.1)
    policy = plant.make_policy(torch.Generator().manual_seed(0))
    actor = LivePolicy(plant, policy, config, generator=torch.Generator().manual_seed(0))
    observation = torch.zeros(len(plant.observations), dtype=torch.float64)
    firsts = []
    for _ in range(2):
        actor.begin(policy, strength=1.0)
        firsts.append(actor(observation))
        torch.testing.assert_close(actor(observation), firsts[-1], rtol=0, atol=1e-2)
    assert (firsts[0] - firsts[1]).abs().min() > 1e-2


def test_the_strength_falls_to_zero():
    assert [ExplorationConfig(episodes=4).strength(episode) for episode in range(6)] == [1.0, 0.75, 0.5, 0.25, 0.0, 0.0]
    assert ExplorationConfig(episodes=0).strength(9) == 0.0
