"""The cost of held commands, its gradient and its descent beside rollouts and a bounded least-squares problem."""

import numpy as np
import pytest
import torch
from linear_quadratic import LinearQuadratic

from rt_torchrl.control.command_cost import PENALTY, CommandCost, descend
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.plants.signal import Signal, bounds
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.twin import constant


class Untraceable(LinearQuadratic):
    """A plant whose running cost leaves torch."""

    def running_cost(self, t, state, applied, exogenous):
        assert state.isfinite().all().item()
        return super().running_cost(t, state, applied, exogenous)


def by_rollout(plant, plan, state, exogenous, *, hold=1, start=0.0, penalty=PENALTY):
    """J and its gradient by autograd through every step."""
    n, (low, high) = len(exogenous), bounds(plant.actions)
    u = torch.from_numpy(plan).clone().requires_grad_()
    command = (low + (high - low) * u).repeat_interleave(hold, 0)[:n]
    rollout = Rollout(plant, constant(plant.closure), engine="autograd")
    flown = rollout(state[None], exogenous[None], command[None], start=start)
    t = start + plant.dt * torch.arange(n, dtype=torch.float64)
    cost = plant.running_cost(t, flown.states[0, :-1], flown.actions[0], exogenous).mean()
    cost = cost + penalty * ((command - flown.actions[0]) / (high - low)).square().sum(-1).mean()
    return cost.item(), torch.autograd.grad(cost, u)[0].numpy()


@pytest.mark.parametrize("hold, n", [(1, 12), (4, 9)])
@pytest.mark.parametrize("kind", [WindTurbine, LinearQuadratic, Untraceable])
def test_cost_and_gradient_are_those_of_a_rollout(kind, hold, n):
    plant, generator = kind(), torch.Generator().manual_seed(3)
    states, inputs = plant.draw_initial_state(3, generator), plant.draw_exogenous(3, generator)[:, :n]
    cost = CommandCost(plant, constant(plant.closure), n, hold=hold)
    assert cost.shape == (-(-n // hold), len(plant.actions))
    plan = np.random.default_rng(0).random(cost.shape)
    for state, exogenous, start in zip(states, inputs, (0.0, 40.0, 0.0), strict=True):
        cost.begin(state, exogenous, start=start)
        found = cost(plan)
        wanted = by_rollout(plant, plan, state, exogenous, hold=hold, start=start)
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * np.abs(other).max())


def test_a_cost_without_finite_ranges_is_refused():
    plant = LinearQuadratic()
    plant.actions = (Signal(symbol="a", name="force", unit="N"),)
    with pytest.raises(ValueError, match="force of plant 'linear_quadratic' have no finite range"):
        CommandCost(plant, plant.closure, 10)


def test_a_descent_goes_round_points_where_the_cost_is_not_finite():
    def evaluate(point):
        x = float(point[0])
        with np.errstate(invalid="ignore"):
            return float((x - 0.7) ** 2 - 0.01 * np.sqrt(0.8 - x)), np.array(
                [2.0 * (x - 0.7) + 0.005 / np.sqrt(0.8 - x)]
            )

    found = descend(evaluate, np.array([0.1]), iterations=1000, tolerance=1e-10)
    x = np.linspace(0.0, 0.8, 80_001)
    np.testing.assert_allclose(found.point, x[np.argmin((x - 0.7) ** 2 - 0.01 * np.sqrt(0.8 - x))], atol=1e-4)
    with pytest.raises(FloatingPointError, match="at the start"):
        descend(evaluate, np.array([0.9]), iterations=1000, tolerance=1e-10)
