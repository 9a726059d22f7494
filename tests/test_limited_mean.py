"""The mean of costs whose gradient limits that of each episode, against its formula and on an unstable loop."""

import math

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from torch import nn

from rt_torchrl import DigitalTwin, PlannerConfig
from rt_torchrl.optimisers.descent import DescentConfig
from rt_torchrl.optimisers.limited_mean import limited_mean
from rt_torchrl.steps.plan import WholeEpisodes
from rt_torchrl.trajectories.trajectory import Scenario

SIZE = 14.0**0.5
"""Norm of the weights."""


def slopes_and_costs(slopes, costs):
    """Costs of episodes that are linear in two weights, with given values and slopes at their present values."""
    weights = [torch.tensor([1.0, 2.0]).double().requires_grad_(), torch.tensor(3.0).double().requires_grad_()]
    slopes = torch.tensor(slopes, dtype=torch.float64)
    change = slopes[:, :2] @ (weights[0] - weights[0].detach()) + slopes[:, 2] * (weights[1] - weights[1].detach())
    return weights, torch.tensor(costs, dtype=torch.float64) + change


def gradient(weights, mean):
    return torch.cat([g.flatten() for g in torch.autograd.grad(mean, weights)])


def test_without_an_exploding_gradient_it_is_the_mean():
    weights, costs = slopes_and_costs([[1.0, 0.0, 2.0], [0.0, -3.0, 0.0], [0.5, 0.5, 0.5]], [1.0, 2.0, 6.0])
    found = limited_mean(costs, weights, 10.0)
    assert found.item() == 3.0
    expected = torch.tensor([0.5, -2.5 / 3.0, 2.5 / 3.0]).double()
    torch.testing.assert_close(gradient(weights, found), expected)
    torch.testing.assert_close(gradient(weights, limited_mean(costs, weights, math.inf)), expected)


def test_gradients_that_explode_in_most_episodes_are_limited():
    weights, costs = slopes_and_costs([[1.0, 0.0, 0.0]] * 3 + [[0.0, 1e4, 0.0], [0.0, 0.0, 1e5]] * 3, [1.0] * 9)
    found = gradient(weights, limited_mean(costs, weights, 4.0))
    torch.testing.assert_close(found, torch.tensor([3.0, 12.0 / SIZE, 12.0 / SIZE]).double() / 9.0)


def test_an_exploding_gradient_counts_as_the_limit_says():
    slopes = [[1.0, 0.0, 0.0]] * 7 + [[0.0, 0.0, 5000.0]]
    weights, costs = slopes_and_costs(slopes, [1.0] * 8)
    found = limited_mean(costs, weights, 4.0)
    assert found.item() == 1.0
    torch.testing.assert_close(gradient(weights, found), torch.tensor([7.0, 0.0, 4.0 / SIZE]).double() / 8.0)


def test_an_episode_that_costs_more_may_have_a_longer_gradient():
    slopes = [[1.0, 0.0, 0.0]] * 7 + [[0.0, 0.0, 5000.0]]
    weights, costs = slopes_and_costs(slopes, [2.0] * 7 + [200.0])
    found = gradient(weights, limited_mean(costs, weights, 4.0))
    torch.testing.assert_close(found, torch.tensor([7.0, 0.0, 4.0 * 200.0 / SIZE]).double() / 8.0)


@pytest.mark.parametrize("costs", [[1.0] * 8, [0.0] * 8])
def test_a_few_episodes_off_their_bounds_count_in_full(costs):
    """A policy at its bounds has no gradient in most episodes, and what the others say is not an explosion."""
    weights, costs = slopes_and_costs([[0.0] * 3] * 7 + [[0.0, 0.3, 0.4]], costs)
    found = gradient(weights, limited_mean(costs, weights, 10.0))
    torch.testing.assert_close(found, torch.tensor([0.0, 0.3, 0.4]).double() / 8.0)


def test_a_gradient_that_is_not_a_number_is_not_hidden():
    weights, costs = slopes_and_costs([[1.0, 0.0, 0.0]] * 7 + [[math.nan, 0.0, 0.0]], [1.0] * 8)
    assert gradient(weights, limited_mean(costs, weights, 10.0)).isnan().any()


@pytest.mark.parametrize("engine", ["native", "autograd"])
def test_gradients_of_flights_are_limited_alike(engine):
    plant, generator, policy = LinearQuadratic(), torch.Generator().manual_seed(0), LinearGain([[0.4, 0.2]])
    twin = DigitalTwin(plant, plant.closure, engine=engine)
    start, exogenous = plant.draw_initial_state(6, generator), plant.draw_exogenous(6, generator)
    costs, weights = twin.episode_costs(policy, start, exogenous), list(policy.parameters())
    alone = [twin.cost(policy, s[None], z[None]) for s, z in zip(start, exogenous, strict=True)]
    each = torch.stack([gradient(weights, cost) for cost in alone])
    norms = each.norm(dim=1)
    shares = (0.5 * costs.detach() / policy.gain.detach().norm() / norms).clamp_max(1.0)
    assert shares.min() < 0.9
    torch.testing.assert_close(gradient(weights, limited_mean(costs, weights, 0.5)), (shares @ each) / 6.0)


class Hunting(DigitalTwin):
    """Fifty episodes like bowls; in the last one, the cost also ripples by 1e-8 with the gain."""

    def episode_costs(self, policy: nn.Module, initial_state: torch.Tensor, exogenous: torch.Tensor) -> torch.Tensor:
        gain = policy.gain.flatten()
        ripple = 1e-8 * torch.sin(1e13 * gain[1])
        bowl = 1.0 + 0.5 * (gain - torch.tensor([2.0, 3.0]).double()).square().sum()
        return torch.stack([bowl] * 49 + [bowl + ripple])


@pytest.mark.parametrize(("method", "far"), [("multi_start", False), ("single_start", True)])
def test_a_plan_goes_on_beside_an_episode_whose_gradient_explodes(method, far):
    plant, policy = LinearQuadratic(), LinearGain([[-1.0, -1.0]])
    config = PlannerConfig(method=method, iterations=40, descent=DescentConfig(optimiser="lbfgs", rate=1.0))
    nothing = torch.zeros(1, 2, dtype=torch.float64)
    planner = WholeEpisodes(Hunting(plant, plant.closure), policy, config)
    found = planner.plan(Scenario(nothing, torch.zeros(1, plant.n_steps, 1, dtype=torch.float64)))
    assert found.start == pytest.approx(13.5)
    assert (found.best > 3.0) is far
