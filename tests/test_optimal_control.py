"""Optimal commands, behind rate limits as well, and their cost: quadratic programs, Riccati, rollouts, differences."""

import numpy as np
import pytest
import torch
from linear_quadratic import LinearQuadratic
from scipy.linalg import solve_discrete_are
from scipy.optimize import lsq_linear

from rt_torchrl.control.command_cost import BoundedDescentConfig, CommandCost, descend, projected_gradient
from rt_torchrl.control.forecasts import Foreseen
from rt_torchrl.control.predictive_control import PredictiveConfig, RecedingHorizon
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.evaluation.clairvoyant import RelaxedCost, clairvoyant, constant_starts, random_start
from rt_torchrl.plants.signal import Signal, bounds
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.trajectory import control_cost
from rt_torchrl.trajectories.twin import constant


def matrices(plant):
    """The interval as s⁺ = A s + B a + D z, by the four terms of Runge and Kutta's scheme, and the weights of L_a."""
    continuous = np.array(plant.A) + np.array(plant.true_closure)
    power, total = np.eye(2), np.zeros((2, 2))
    for order in range(1, 5):
        total = total + power * plant.dt / order
        power = power @ continuous * plant.dt / order
    # total is now dt·(I + A dt/2 + (A dt)²/6 + (A dt)³/24).
    A = np.eye(2) + continuous @ total
    return A, total @ np.array(plant.B), total @ np.array(plant.D), np.array(plant.Q), np.array(plant.R)


class PricedEnd(LinearQuadratic):
    """The problem with a cost of its end state."""

    price = 8.0

    def terminal_cost(self, state):
        return self.price * state.square().sum(-1)


def least_squares(plant, s_0, z, basis):
    """Matrix and right side whose squares are the cost of an episode, by variables x of which ``basis`` x acts."""
    A, B, D, Q, R = matrices(plant)
    root, weight = np.linalg.cholesky(Q).T, np.sqrt(getattr(plant, "price", 0.0) / plant.dt)
    gain, free, rows, rest = np.zeros((2, basis.shape[1])), s_0.copy(), [], []
    for now, z_k in zip(basis, z, strict=True):
        rows += [root @ gain, np.sqrt(R[0, 0]) * now[None]]
        rest += [root @ free, np.zeros(1)]
        gain, free = A @ gain + B * now, A @ free + D[:, 0] * z_k
    return np.concatenate([*rows, weight * gain]), -np.concatenate([*rest, weight * free])


def quadratic_program(plant, s_0, z):
    """The optimal actions of an episode as a bounded least-squares problem, and their J_a."""
    found = lsq_linear(*least_squares(plant, s_0, z, np.eye(len(z))), bounds=(-2.0, 2.0), tol=1e-14)
    return found.x, 2.0 * found.cost / len(z)


def episodes(plant, batch, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 2.0 * plant.draw_initial_state(batch, generator), plant.draw_exogenous(batch, generator)


@pytest.mark.parametrize("kind", [LinearQuadratic, PricedEnd])
def test_the_clairvoyant_optimum_is_that_of_a_quadratic_program(kind):
    plant = kind(horizon=4.0, noise=0.5)
    state, exogenous = episodes(plant, 3)
    starts = constant_starts(plant, 3, plant.n_steps)
    starts["random"] = random_start(plant, 3, plant.n_steps, generator=torch.Generator().manual_seed(1))
    found = clairvoyant(plant, state, exogenous, starts, config=BoundedDescentConfig(tolerance=0.0))
    saturated = 0
    for episode in range(3):
        actions, cost = quadratic_program(plant, state[episode].numpy(), exogenous[episode, :, 0].numpy())
        np.testing.assert_allclose(found.flown.actions[episode, :, 0].numpy(), actions, atol=2e-4)
        assert found.costs[episode].item() == pytest.approx(cost, rel=1e-7)
        saturated += (np.abs(actions) > 2.0 - 1e-9).sum()
    assert saturated > 0
    assert max(found.spread().values()) < 1e-6 and min(found.spread().values()) > -1e-12
    assert set(found.start_costs) == set(starts) and found.excess == 0.0
    assert found.gradient.max() < 1e-5
    torch.testing.assert_close(found.costs, control_cost(plant, found.flown))


def test_a_horizon_with_riccatis_cost_is_the_linear_quadratic_regulator():
    plant = LinearQuadratic(horizon=3.0, noise=0.0)
    A, B, _, Q, R = matrices(plant)
    P = solve_discrete_are(A, B, Q, R)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    value = torch.from_numpy(P * plant.dt)
    config = PredictiveConfig(horizon=0.3, tolerance=0.0, iterations=200)
    controller = RecedingHorizon(plant, plant.closure, config, terminal=lambda end: ((end @ value) * end).sum(-1))
    state = torch.tensor([[0.5, -0.3], [-0.2, 0.6]], dtype=torch.float64)
    flown = controller.fly(state, torch.zeros(2, plant.n_steps, 1, dtype=torch.float64))
    s = state.numpy().T
    for k in range(plant.n_steps):
        np.testing.assert_allclose(flown.actions[:, k].numpy().T, -K @ s, atol=1e-5)
        s = A @ s - B @ K @ s
    assert len(controller.solves) == 2 * plant.n_steps and not any(solve.late for solve in controller.solves)


def test_a_plan_of_a_whole_episode_with_a_preview_is_the_clairvoyant_optimum():
    plant = LinearQuadratic(horizon=3.0, noise=0.5)
    state, exogenous = episodes(plant, 2)
    config = PredictiveConfig(horizon=3.0, period=3.0, tolerance=0.0, iterations=300)
    controller = RecedingHorizon(plant, plant.closure, config, forecast=Foreseen(exogenous, dt=plant.dt))
    costs = control_cost(plant, controller.fly(state, exogenous))
    for episode, cost in enumerate(costs.tolist()):
        wanted = quadratic_program(plant, state[episode].numpy(), exogenous[episode, :, 0].numpy())[1]
        assert cost == pytest.approx(wanted, rel=1e-6)


def test_late_solves_leave_the_last_plan():
    plant = LinearQuadratic(horizon=2.0, noise=0.5)
    state, exogenous = episodes(plant, 1)
    config = PredictiveConfig(horizon=1.0, period=0.2, deadline=1e-9)
    late = RecedingHorizon(plant, plant.closure, config)
    first = late.plan(0.0, state, exogenous[:, 0])
    second = late.plan(0.2, state, exogenous[:, 2])
    assert [solve.late for solve in late.solves] == [False, True]
    torch.testing.assert_close(second[:, :-2], first[:, 2:], rtol=0.0, atol=1e-15)
    assert (second[:, -2:] == first[:, -1]).all()
    late.begin()
    late.plan(0.0, state, exogenous[:, 0])
    assert not late.solves[-1].late  # there is no plan to go on with


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
        return super().draw_initial_state(batch, generator) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)


def program(plant, s_0, z):
    """The optimal actions and their J_a, as a least-squares problem in the bounded changes of the force."""
    sums, bounds = np.tril(np.ones((len(z), len(z)))), (-plant.step_limit, plant.step_limit)
    found = lsq_linear(*least_squares(plant, s_0, z, sums), bounds=bounds, tol=1e-14)
    return sums @ found.x, 2.0 * found.cost / len(z)


def test_the_optimum_is_that_of_a_quadratic_program_in_the_rates():
    plant = RateLimited(horizon=4.0, noise=0.5)
    state, exogenous = episodes(plant, 3)
    starts = {"constant": constant_starts(plant, 3, plant.n_steps)["constant 0.25"]}
    starts["random"] = random_start(plant, 3, plant.n_steps, generator=torch.Generator().manual_seed(1))
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


class Untraceable(LinearQuadratic):
    """A plant whose running cost leaves torch."""

    def running_cost(self, t, state, applied, exogenous):
        assert state.isfinite().all().item()
        return super().running_cost(t, state, applied, exogenous)


def by_rollout(plant, unit, state, exogenous, *, hold, penalty, start=0.0, terminal=None):
    """J and its gradient by autograd through every step."""
    low, high = bounds(plant.actions)
    u = torch.from_numpy(unit).clone().requires_grad_()
    command = (low + (high - low) * u).repeat_interleave(hold, 1)[:, : exogenous.shape[1]]
    flown = Rollout(plant, constant(plant.closure), engine="autograd")(state, exogenous, command, start=start)
    t = start + plant.dt * torch.arange(exogenous.shape[1], dtype=torch.float64)
    cost = plant.running_cost(t, flown.states[:, :-1], flown.actions, exogenous).mean(-1)
    cost = cost + penalty * ((command - flown.actions) / (high - low)).square().sum(-1).mean(-1)
    if terminal is not None:
        cost = cost + terminal(flown.states[:, -1]) / (exogenous.shape[1] * plant.dt)
    return cost.detach().numpy(), torch.autograd.grad(cost.sum(), u)[0].numpy()


@pytest.mark.parametrize("hold, n, batch, terminal", [(1, 12, 1, False), (5, 12, 11, False), (4, 9, 3, True)])
@pytest.mark.parametrize("kind", [WindTurbine, LinearQuadratic, Untraceable])
def test_cost_and_gradient_are_those_of_a_rollout(kind, hold, n, batch, terminal):
    plant, generator = kind(), torch.Generator().manual_seed(3)
    state, exogenous = plant.draw_initial_state(batch, generator), plant.draw_exogenous(batch, generator)[:, :n]
    value = (lambda end: 0.3 * end[:, 0] ** 2 + end[:, 1]) if terminal else None
    cost = CommandCost(plant, constant(plant.closure), hold=hold, terminal=value)
    cost.interval.penalty.fill_(0.7)
    unit = np.random.default_rng(0).random((batch, cost.blocks(n), len(plant.actions)))
    for start in (0.0, 40.0):  # a second window uses the arrays of the first
        cost.begin(state, exogenous, start=start)
        found = cost(unit)
        wanted = by_rollout(plant, unit, state, exogenous, hold=hold, penalty=0.7, start=start, terminal=value)
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * np.abs(other).max())


def test_commands_beyond_a_rate_limit_have_a_gradient():
    plant, generator = WindTurbine(), torch.Generator().manual_seed(0)
    state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)[:, :2]
    unit = np.full((1, 2, 2), 1.0)  # both actuators start far below, at their last actions
    gradients = {}
    for penalty in (0.0, 1.0):
        cost = CommandCost(plant, constant(plant.closure))
        cost.interval.penalty.fill_(penalty)
        cost.begin(state, exogenous)
        gradients[penalty] = cost(unit)[1]
    # The torque of the second interval is within its limit; all others are beyond.
    assert (gradients[0.0][0][0] == 0.0).all() and gradients[0.0][0][1, 1] == 0.0
    assert (gradients[1.0][0] > 0.0).all()


def test_a_cost_without_finite_ranges_is_refused():
    plant = LinearQuadratic()
    plant.actions = (Signal(symbol="a", name="force", unit="N"),)
    with pytest.raises(ValueError, match="force of plant 'linear_quadratic' have no finite range"):
        CommandCost(plant, plant.closure)
    with pytest.raises(ValueError, match="hold=0"):
        CommandCost(LinearQuadratic(), plant.closure, hold=0)


def test_the_descent_solves_a_bounded_least_squares_problem():
    rng = np.random.default_rng(0)
    matrix, target = rng.normal(size=(30, 12)), 3.0 * rng.normal(size=30)
    wanted = lsq_linear(matrix, target, bounds=(0.0, 1.0), tol=1e-14)
    assert (wanted.active_mask != 0).any() and (wanted.active_mask == 0).any()

    def evaluate(point):
        rest = matrix @ point[0] - target
        return 0.5 * float(rest @ rest), (matrix.T @ rest)[None]

    found = descend(evaluate, np.full((1, 12), 0.5), BoundedDescentConfig(tolerance=0.0))
    np.testing.assert_allclose(found.point[0], wanted.x, atol=1e-6)
    np.testing.assert_allclose(found.cost, wanted.cost, rtol=1e-10)
    assert projected_gradient(found.point, found.gradient)[0] < 1e-5 < np.linalg.norm(found.gradient)


def test_a_descent_goes_round_points_where_the_cost_is_not_finite():
    def evaluate(point):
        x = float(point[0])
        with np.errstate(invalid="ignore"):
            return float((x - 0.7) ** 2 - 0.01 * np.sqrt(0.8 - x)), np.array(
                [2.0 * (x - 0.7) + 0.005 / np.sqrt(0.8 - x)]
            )

    found = descend(evaluate, np.array([0.1]), BoundedDescentConfig())
    x = np.linspace(0.0, 0.8, 80_001)
    np.testing.assert_allclose(found.point, x[np.argmin((x - 0.7) ** 2 - 0.01 * np.sqrt(0.8 - x))], atol=1e-4)
    with pytest.raises(FloatingPointError, match="at the start"):
        descend(evaluate, np.array([0.9]), BoundedDescentConfig())
