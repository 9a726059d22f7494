"""Optimal commands behind rate limits: against quadratic programming in the rates, and against central differences."""

import numpy as np
import pytest
import torch
from linear_quadratic import LinearQuadratic
from scipy.optimize import lsq_linear
from test_optimal_control import matrices

from rt_torchrl.control.receding_horizon import BoundedDescentConfig
from rt_torchrl.evaluation.clairvoyant import RelaxedCost, clairvoyant, constant_starts, held_back, random_starts
from rt_torchrl.plants.signal import Signal
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.twin import constant


class RateLimited(LinearQuadratic):
    """The problem with a force that turns by at most 0.15 N in an interval, and a range that it does not reach."""

    states = (*LinearQuadratic.states, Signal(symbol="a", name="force", unit="N"))
    actions = (Signal(symbol="a", name="force", unit="N", low=-3.0, high=3.0),)
    step_limit = 0.15

    def vector_field(self, t, state, action, exogenous, closure):
        field = super().vector_field(t, state[..., :2], action, exogenous, closure)
        return torch.cat([field, torch.zeros_like(state[..., 2:])], -1)

    def actuate(self, state, command):
        return state[..., 2:] + (command - state[..., 2:]).clamp(-self.step_limit, self.step_limit)

    def latch(self, state, applied):
        return torch.cat([state[..., :2], applied], -1)

    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state[..., :2], applied, exogenous)

    def draw_initial_state(self, batch, generator):
        return 2.0 * super().draw_initial_state(batch, generator) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)


def program(plant, s_0, z):
    """The optimal actions and their J_a, as a least-squares problem in the bounded changes of the force."""
    A, B, D, Q, R = matrices(plant)
    n, root = len(z), np.linalg.cholesky(Q).T
    sums, rows, rest = np.tril(np.ones((n, n))), [], []
    gain, free = np.zeros((2, n)), s_0.copy()
    for k in range(n):
        rows += [root @ gain, np.sqrt(R[0, 0]) * sums[k : k + 1]]
        rest += [root @ free, np.zeros(1)]
        gain, free = A @ gain + B * sums[k : k + 1], A @ free + D[:, 0] * z[k]
    bounds = -plant.step_limit, plant.step_limit
    found = lsq_linear(np.concatenate(rows), -np.concatenate(rest), bounds=bounds, tol=1e-14)
    return sums @ found.x, 2.0 * found.cost / n


def episodes(plant, batch, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return plant.draw_initial_state(batch, generator), plant.draw_exogenous(batch, generator)


def test_the_optimum_is_that_of_a_quadratic_program_in_the_rates():
    plant = RateLimited(horizon=4.0, noise=0.5)
    state, exogenous = episodes(plant, 3)
    starts = {"constant": constant_starts(plant, 3, plant.n_steps)["constant 0.25"]}
    starts |= random_starts(plant, 3, plant.n_steps, generator=torch.Generator().manual_seed(1))
    config = BoundedDescentConfig(iterations=2000, tolerance=0.0)
    found = clairvoyant(plant, state, exogenous, starts, config=config)
    limited = 0
    for episode in range(3):
        actions, cost = program(plant, state[episode, :2].numpy(), exogenous[episode, :, 0].numpy())
        assert found.costs[episode].item() == pytest.approx(cost, rel=1e-6)
        np.testing.assert_allclose(found.flown.actions[episode, :, 0].detach().numpy(), actions, atol=5e-3)
        limited += (np.abs(np.diff(actions, prepend=0.0)) > plant.step_limit - 1e-9).sum()
    assert limited > 20
    assert max(found.spread().values()) < 5e-6 and found.excess < 1e-4 and found.gradient.max() < 1e-4


def test_no_episode_ends_above_its_start():
    plant = RateLimited(horizon=4.0, noise=0.5)
    state, exogenous = episodes(plant, 2)
    best = torch.stack(
        [
            torch.from_numpy(program(plant, state[k, :2].numpy(), exogenous[k, :, 0].numpy())[0]).unsqueeze(-1)
            for k in range(2)
        ]
    )
    config = BoundedDescentConfig(iterations=10)  # one for each charge, which leaves the optimum
    found = clairvoyant(plant, state, exogenous, {"best": best}, config=config)
    assert (found.costs <= Rollout(plant, plant.closure).costs(state, exogenous, best) + 1e-12).all()


def test_the_gradient_is_that_of_central_differences_before_and_after_a_charge():
    plant = RateLimited(horizon=1.0, noise=0.5)
    state, exogenous = episodes(plant, 2)
    cost = RelaxedCost(plant, constant(plant.closure), terminal=lambda end: end[:, 0] ** 2)
    cost.begin(state, exogenous)
    unit = np.random.default_rng(0).random((2, 10, 1))
    found = []
    for weight in (0.5, 4.0):
        cost.charge(unit, weight)
        costs, gradient = cost(unit)
        for k in range(10):
            shift = np.zeros_like(unit)
            shift[:, k] = 1e-6
            slope = (cost(unit + shift)[0] - cost(unit - shift)[0]) / 2e-6
            np.testing.assert_allclose(gradient[:, k, 0], slope, rtol=1e-5, atol=1e-6)
        found.append(costs)
    assert (np.abs(found[0] - found[1]) > 1e-3).all()  # the second has multipliers, too


def test_only_actuators_with_limits_hold_commands_back():
    for plant, limited in ((LinearQuadratic(), False), (RateLimited(), True)):
        assert held_back(plant, plant.draw_initial_state(2, torch.Generator().manual_seed(0))) == limited
