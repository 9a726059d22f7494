"""The real system in simulation: its step, its clock, its sensors, wear and divergence."""

import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic

from rt_torchrl import DivergenceError, PlantEnv


def act(env, found, action):
    """Make one step and return its TensorDict, with ``next``."""
    return env.step(found.clone().set("action", action))


def uniform_actions(env, seed):
    low, high = env.action_spec.space.low, env.action_spec.space.high
    share = torch.rand(low.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return low + share * (high - low)


class Explosive(LinearClosure):
    def forward(self, features):
        return 1e3 * features**3


def test_divergence_is_raised_with_time_state_and_command():
    plant = LinearQuadratic()
    plant.closure = Explosive(plant.true_closure)
    env = PlantEnv(plant)
    found = env.reset()
    message = (
        r"plant 'linear_quadratic' diverged at t = \d\S* s: state \[\[.*\], command \[\[.*\], "
        r"exogenous input \[\["
    )
    with pytest.raises(DivergenceError, match=message):
        for k in range(50):
            found = act(env, found, uniform_actions(env, k))["next"].exclude("reward")


def test_sensors_err_by_a_share_of_what_they_read():
    plant = LinearQuadratic(horizon=30.0, noise=0.0)
    clean, noisy = (PlantEnv(plant, seed=1, noise=noise) for noise in (0.0, 0.02))
    policy = lambda td: td.set("action", torch.zeros(1, 1).double())  # noqa: E731
    true, read = (env.rollout(300, policy)[0] for env in (clean, noisy))
    ratio = (read["state"] / true["state"] - 1.0) / 0.02
    # Of 600 standard normals: mean within 4/√600, deviation within 4/√1200.
    assert ratio.mean().abs() < 0.16 and (ratio.std() - 1.0).abs() < 0.12
    # On this plant the observation is the state, and what is read at the end of a step is what the next one sees.
    assert torch.equal(read["observation"], read["state"])
    assert torch.equal(read["next", "state"][:-1], read["state"][1:])
