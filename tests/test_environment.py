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


class Clock(LinearQuadratic):
    """A plant whose observation, motion and cost depend on the time."""

    def vector_field(self, t, state, action, exogenous, closure):
        return torch.ones_like(state) * t.unsqueeze(-1)

    def observe(self, t, state, exogenous):
        return torch.ones_like(state) * t.unsqueeze(-1)

    def running_cost(self, t, state, applied, exogenous):
        return t.expand_as(state[..., 0])


def test_clock_is_that_of_the_twin_to_the_last_bit():
    """t_k = k dt in double precision, in the observation, the cost and the field: s_n − s_0 = ½T²."""
    env = PlantEnv(Clock(dt=0.1, horizon=5.0))
    episode = env.rollout(50)
    t = 0.1 * torch.arange(51, dtype=torch.float64)
    assert torch.equal(episode["observation"], t[:-1, None].expand(1, 50, 2))
    assert torch.equal(episode["next", "observation"], t[1:, None].expand(1, 50, 2))
    assert torch.equal(episode["next", "reward"][..., 0], -t[:-1].expand(1, 50))
    moved = episode["next", "state"][:, -1] - episode["state"][:, 0]
    # Exact quadrature of a linear function: rounding of 50 sums.
    torch.testing.assert_close(moved, torch.full((1, 2), 12.5, dtype=torch.float64), rtol=1e-13, atol=0)


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
