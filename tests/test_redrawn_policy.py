"""Exploration by drawn weights, and updates that the twin finds worse."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from test_algorithm import weights
from test_ddpg import seeded

from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.systems.collectors import EpisodeCollector, FlightCollector
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.systems.redrawn_policy import RedrawnPolicy
from rt_torchrl.trajectories.state_feedback import StateFeedback

PLANT = LinearQuadratic(horizon=2.0)


def redrawn(plant=PLANT, seed=4, **options):
    policy = plant.make_policy(seeded(1))
    options = {"parts": 3, "spread": 0.5, **options}
    return policy, RedrawnPolicy(plant, policy, **options, generator=seeded(seed))


def test_weights_are_drawn_around_those_of_the_policy():
    policy, found = redrawn(spread=0.5)
    start = weights(policy)
    drawn = torch.stack([weights(part) for _ in range(2000) for part, _, _ in found.draw_parts()[:1]])
    torch.testing.assert_close(drawn.mean(0), start, rtol=0, atol=0.05)
    names = [weight.shape[-1] ** -0.5 if weight.dim() > 1 else 1.0 for weight in policy.parameters()]
    spread = torch.cat([torch.full((w.numel(),), 0.5 * s) for w, s in zip(policy.parameters(), names, strict=True)])
    torch.testing.assert_close(drawn.std(0), spread.double(), rtol=0.1, atol=0.0)
    assert torch.equal(weights(policy), start) and isinstance(found, StateFeedback)


def test_parts_cover_the_episode():
    _, found = redrawn()
    assert [(first, last) for _, first, last in found.draw_parts()] == [(0, 7), (7, 14), (14, 20)]


@pytest.mark.parametrize("plant", [PLANT, WindTurbine(horizon=20.0)])
def test_machine_code_flies_what_steps_fly(plant):
    flown = []
    for kind in (FlightCollector, EpisodeCollector):
        _, found = redrawn(plant)
        actor = LivePolicy(plant, found, ExplorationConfig(), generator=seeded(2))
        env = PlantEnv(plant, seed=3)
        actor.begin(found, strength=0.0)
        flown.append(kind(env, actor, *([] if kind is FlightCollector else [plant])).rollout())
    for key in ("state", "action", "observation", ("next", "reward"), ("next", "applied")):
        torch.testing.assert_close(flown[0][key], flown[1][key], rtol=1e-9, atol=1e-9)


def test_the_first_episodes_alone_draw_weights():
    config = ExplorationConfig(redrawn=2, draws=4)
    actor = LivePolicy(PLANT, PLANT.make_policy(seeded(1)), config, generator=seeded(2))
    acting = [actor.exploring(actor.policy, episode) for episode in range(3)]
    assert [isinstance(each, RedrawnPolicy) for each in acting] == [True, True, False] and acting[2] is actor.policy


def test_some_noise_stays():
    strengths = [ExplorationConfig(episodes=4, least=0.3).strength(episode) for episode in range(6)]
    assert strengths == [1.0, 0.75, 0.5, 0.3, 0.3, 0.3]
    assert ExplorationConfig(episodes=0, least=0.3).strength(9) == 0.3


@pytest.mark.parametrize("change", [{"least": -0.1}, {"redrawn": -1}, {"draws": 0}, {"weight_spread": -1.0}])
def test_wrong_parameters_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        ExplorationConfig(**change)
