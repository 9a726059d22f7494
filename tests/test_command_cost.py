"""The cost of held commands: against rollouts, torch's own gradients, and the descent between bounds."""

import numpy as np
import pytest
import torch
from linear_quadratic import LinearQuadratic
from scipy.optimize import lsq_linear

from rt_torchrl.control.command_cost import BoundedDescentConfig, CommandCost, descend, projected_gradient
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.plants.signal import Signal, bounds
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.twin import constant


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
    cost = CommandCost(plant, constant(plant.closure), hold=hold, penalty=0.7, terminal=value)
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
        cost = CommandCost(plant, constant(plant.closure), penalty=penalty)
        cost.begin(state, exogenous)
        gradients[penalty] = cost(unit)[1]
    # The torque of the second interval is within its limit; all others are beyond.
    assert (gradients[0.0][0][0] == 0.0).all() and gradients[0.0][0][1, 1] == 0.0
    assert (gradients[1.0][0] > 0.0).all()


def test_commands_and_units_are_each_others_inverse():
    plant = WindTurbine()
    cost = CommandCost(plant, constant(plant.closure), hold=3)
    unit = np.random.default_rng(1).random((2, 4, 2))
    commands = cost.commands(unit, 11)
    assert commands.shape == (2, 11, 2)
    np.testing.assert_allclose(commands[:, 2, 0].numpy(), 43_093.55 * unit[:, 0, 0], rtol=1e-14)
    np.testing.assert_allclose(cost.units(commands), unit, atol=1e-15)


def test_a_cost_without_finite_ranges_is_refused():
    plant = LinearQuadratic()
    plant.actions = (Signal(symbol="a", name="force", unit="N"),)
    with pytest.raises(ValueError, match="force of plant 'linear_quadratic' have no finite range"):
        CommandCost(plant, plant.closure)
    for argument, value in (("hold", 0), ("penalty", -1.0)):
        with pytest.raises(ValueError, match=f"{argument}={value}"):
            CommandCost(LinearQuadratic(), plant.closure, **{argument: value})


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


@pytest.mark.parametrize("option", [{"iterations": 0}, {"memory": 0}, {"tolerance": -1.0}, {"gradient": -1.0}])
def test_impossible_descents_are_refused(option):
    ((name, value),) = option.items()
    with pytest.raises(ValueError, match=f"{name}={value}"):
        BoundedDescentConfig(**option)
