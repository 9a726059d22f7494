"""Gradient descent of steps 4 and 5 on costs with known minima, and the mean that limits exploding gradients."""

import math

import pytest
import torch
from torch import nn

from rt_torchrl.optimisers.descent import Descent, DescentConfig, limited_mean
from rt_torchrl.optimisers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from rt_torchrl.optimisers.simplex import by_simplex

MINIMUM = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
CURVATURE = torch.tensor([1.0, 4.0, 10.0], dtype=torch.float64)


class Point(nn.Module):
    def __init__(self, start=(0.0, 0.0, 0.0)):
        super().__init__()
        self.at = nn.Parameter(torch.tensor(start, dtype=torch.float64))


class Bowl:
    """½ Σ c_i (x_i − m_i)², counting its evaluations."""

    def __init__(self, point, offset=0.0):
        self.point, self.offset, self.seen, self.with_gradient = point, offset, [], 0

    def __call__(self):
        cost = 0.5 * (CURVATURE * (self.point.at - MINIMUM) ** 2).sum() + self.offset
        self.seen.append((cost.item(), self.point.at.detach().clone()))
        self.with_gradient += torch.is_grad_enabled()
        return cost


def test_weights_beyond_single_precision_are_not_kept():
    """The cost falls until the weights are 1e40, which neither dashboards nor exported controllers can hold."""
    point = Point()
    found = Descent(point, DescentConfig(rate=1e39)).run(lambda: (1.0 - 1e-40 * point.at.sum()).square(), 3)
    assert found.best == found.start == 1.0 and not point.at.any()


@pytest.mark.parametrize("optimiser, rate", [("adam", 3.0), ("adam", 0.1), ("lbfgs", 5.0), ("lbfgs", 1.0)])
@pytest.mark.parametrize("iterations", [1, 2, 7])
def test_best_weights_are_kept(optimiser, rate, iterations):
    """With a rate of 3 Adam jumps over the minimum and climbs; what remains is the lowest point evaluated."""
    point = Point((0.9, -1.9, 0.6))
    cost = Bowl(point)
    found = Descent(point, DescentConfig(optimiser=optimiser, rate=rate)).run(cost, iterations)
    best, where = min(cost.seen, key=lambda pair: pair[0])
    assert found.best == best and torch.equal(point.at.detach(), where)
    # Closed forms at the start: ½(0.1² + 4·0.1² + 10·0.1²) and |(−0.1, 0.4, 1)|.
    assert found.start == cost.seen[0][0] == pytest.approx(0.075) and found.gradient == pytest.approx(1.17**0.5)
    # The line search of L-BFGS has evaluated where it ends; Adam has not evaluated its last step.
    assert len(cost.seen) - (optimiser == "adam") == found.iterations == cost.with_gradient == iterations
    assert optimiser == "lbfgs" or rate < 3.0 or best == found.start


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
def test_stops_at_the_first_point_below_a_cost(optimiser):
    cost = Bowl(Point())
    found = Descent(cost.point, DescentConfig(optimiser=optimiser, rate=0.1)).run(cost, 500, stop_below=2.5)
    assert found.best < 2.5 < found.start and found.iterations < 100
    assert [value < 2.5 for value, _ in cost.seen] == [False] * (len(cost.seen) - 1) + [True]


def test_adam_keeps_its_moments_between_runs_and_restart_forgets_them():
    """Two runs of one step are two steps of torch's Adam on the gradients relative to the cost at the start of each;
    after a restart the step is the first one again: its length is the rate in every direction, the gradient's sign."""
    config = DescentConfig(rate=0.1, gradient_limit=100.0)
    point, by_hand = Point(), Point()
    descent = Descent(point, config)
    adam = torch.optim.Adam(by_hand.parameters(), lr=0.1, betas=(0.9, 0.9))
    for _ in range(2):
        descent.run(Bowl(point), 1)
        start = Bowl(by_hand)().item()
        by_hand.at.grad = CURVATURE * (by_hand.at.detach() - MINIMUM) / start
        adam.step()
    # The same operations in another order: rounding.
    torch.testing.assert_close(point.at, by_hand.at, rtol=1e-14, atol=1e-15)
    before = point.at.detach().clone()
    descent.restart()
    descent.run(Bowl(point), 1)
    # Adam's ε = 1e-8 beside relative gradients of a tenth and more.
    torch.testing.assert_close(point.at.detach() - before, 0.1 * (MINIMUM - before).sign(), rtol=1e-6, atol=0)


class Cliff(Bowl):
    """The bowl, which diverges in one of three ways where the second weight is below −1."""

    def __init__(self, point, kind):
        super().__init__(point)
        self.kind = kind

    def __call__(self):
        cost = super().__call__()
        if self.point.at[1].item() >= -1.0:
            return cost
        if self.kind == "raises":
            raise FloatingPointError("diverged")
        # √0 has an infinite slope where the cost itself is finite.
        return cost * math.nan if self.kind == "nan" else cost + 0.0 * (self.point.at - self.point.at).sum().sqrt()


@pytest.mark.parametrize("kind", ["raises", "nan", "infinite gradient"])
@pytest.mark.parametrize("optimiser, rate", [("adam", 0.4), ("adam", 3.0), ("lbfgs", 1.0), ("lbfgs", 100.0)])
def test_a_step_that_diverges_is_shortened(optimiser, rate, kind):
    """The minimum lies beyond the cliff: steps lead over it again and again, and the descent comes up to its edge."""
    point = Point()
    cost = Cliff(point, kind)
    found = Descent(point, DescentConfig(optimiser=optimiser, rate=rate)).run(cost, 40)
    assert 1 <= found.iterations == cost.with_gradient <= 40
    over = [at[1].item() < -1.0 for _, at in cost.seen]
    assert any(over) and not all(over)
    # Of the weights after the last step only the cost is asked for, which may be finite where its gradient is not.
    last = range(cost.with_gradient, len(over) if kind == "infinite gradient" else 0)
    sound = [pair for k, pair in enumerate(cost.seen) if k in last or not over[k]]
    best, where = min(sound, key=lambda pair: pair[0])
    assert found.best == best and torch.equal(point.at.detach(), where)
    # At the edge ½·4·1² = 2 is left of 9.75; half a step from the edge may be left beside it.
    assert found.start == pytest.approx(9.75) and found.best < 6.0


@pytest.mark.parametrize("kind", ["raises", "nan", "infinite gradient"])
@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
def test_a_cost_that_diverges_at_the_start_raises(optimiser, kind):
    point = Point((0.0, -1.5, 0.0))
    with pytest.raises(FloatingPointError, match="diverged" if kind == "raises" else "cost=.* is not finite"):
        Descent(point, DescentConfig(optimiser=optimiser)).run(Cliff(point, kind), 5)


class Exploding(Bowl):
    """A bowl whose gradient explodes to either side, as that of a flight that depends on its last digits."""

    def __call__(self):
        cost = super().__call__()
        steep = (1e118 if len(self.seen) == 1 else -1e128) * self.point.at[1]
        return cost + (steep - steep.detach())


def test_lbfgs_ends_where_an_exploding_gradient_leaves_no_direction():
    point = Point()
    cost = Exploding(point)
    found = Descent(point, DescentConfig(optimiser="lbfgs", rate=1.0)).run(cost, 30)
    assert all(at.isfinite().all() for _, at in cost.seen)
    assert found.iterations == len(cost.seen) < 30
    best, where = min(cost.seen, key=lambda pair: pair[0])
    assert found.best == best < found.start and torch.equal(point.at, where)


@pytest.mark.parametrize("offset", [-10.0, -4.0, 10.0])
@pytest.mark.parametrize("optimiser, rate", [("lbfgs", 1.0), ("adam", 0.1)])
def test_a_cost_of_any_sign_descends(optimiser, rate, offset):
    """(w − 1)² + c from w = 3 has its minimum c at 1; with c = −4 it starts at zero."""
    point, config = Point((3.0, 3.0, 3.0)), DescentConfig(optimiser=optimiser, rate=rate)
    found = Descent(point, config).run(lambda: (point.at[0] - 1.0) ** 2 + offset, 200)
    assert found.start == pytest.approx(4.0 + offset, abs=1e-14)
    # L-BFGS stops at a change of the relative cost below 1e-9, Adam circles within a fraction of its step of 0.1.
    assert point.at[0].item() == pytest.approx(1.0, abs=0.01)
    assert found.best == pytest.approx(offset, abs=1e-4)


def test_newton_steps_take_a_negative_cost_to_its_minimum():
    """They end where a step promises less than 1e-4 of the cost, or at the first cost below a threshold."""

    def found_with(**options):
        point = Point()
        cost, slope = Bowl(point, offset=-20.0), lambda: CURVATURE * (point.at - MINIMUM)
        equations = lambda: NormalEquations(cost(), slope(), torch.diag(CURVATURE))  # noqa: E731
        return LevenbergMarquardt(point).run(equations, 30, **options)

    found, stopped = found_with(), found_with(stop_below=-12.0)
    assert found.start == -10.25 and found.best == pytest.approx(-20.0, abs=0.01)
    assert stopped.start == found.start and -20.0 < stopped.best < -12.0 and stopped.iterations < found.iterations


# The mean of costs whose gradient limits that of each episode, against its formula and on an unstable loop.


@pytest.mark.parametrize("size", [1.0, 5.0, 20.0])
def test_a_simplex_of_one_weight_ends_in_a_minimum(size):
    weight = torch.zeros(1, dtype=torch.float64)

    def cost():
        return (weight - 1.0).square().sum() + 0.3 * torch.sin(12.0 * weight).sum()

    lowest = by_simplex([weight], cost, 40, size=size)
    for step in (-1e-3, 1e-3):
        weight += step
        assert cost().item() > lowest
        weight -= step


def slopes_and_costs(slopes, costs):
    """Costs of episodes that are linear in two weights, with given values and slopes at their present values."""
    weights = [torch.tensor([1.0, 2.0]).double().requires_grad_(), torch.tensor(3.0).double().requires_grad_()]
    slopes = torch.tensor(slopes, dtype=torch.float64)
    change = slopes[:, :2] @ (weights[0] - weights[0].detach()) + slopes[:, 2] * (weights[1] - weights[1].detach())
    return weights, torch.tensor(costs, dtype=torch.float64) + change


def gradient(weights, mean):
    return torch.cat([g.flatten() for g in torch.autograd.grad(mean, weights)])


PLAIN = [[1.0, 0.0, 2.0], [0.0, -3.0, 0.0], [0.5, 0.5, 0.5]], [1.0, 2.0, 6.0]
OFF_BOUNDS = [[0.0] * 3] * 7 + [[0.0, 0.3, 0.4]]
"""A policy at its bounds has no gradient in most episodes, and what the others say is not an explosion."""
MEANS = {
    "no explosion": (*PLAIN, 10.0, [0.5, -2.5 / 3.0, 2.5 / 3.0]),
    "no limit": (*PLAIN, math.inf, [0.5, -2.5 / 3.0, 2.5 / 3.0]),
    # The norm of the weights is √14.
    "an explosion": ([[1.0, 0.0, 0.0]] * 7 + [[0.0, 0.0, 5000.0]], [1.0] * 8, 4.0, [7.0 / 8.0, 0.0, 0.5 / 14**0.5]),
    "few episodes off their bounds": (OFF_BOUNDS, [1.0] * 8, 10.0, [0.0, 0.3 / 8.0, 0.4 / 8.0]),
    "costs of zero": (OFF_BOUNDS, [0.0] * 8, 10.0, [0.0, 0.3 / 8.0, 0.4 / 8.0]),
    "no number": ([[1.0, 0.0, 0.0]] * 7 + [[math.nan, 0.0, 0.0]], [1.0] * 8, 10.0, [math.nan, 0.0, 0.0]),
}


@pytest.mark.parametrize("case", MEANS)
def test_the_mean_of_costs_limits_exploding_gradients_alone(case):
    slopes, costs, limit, expected = MEANS[case]
    weights, costs = slopes_and_costs(slopes, costs)
    found = limited_mean(costs, weights, limit)
    assert found.item() == pytest.approx(costs.mean().item(), rel=0.0, abs=0.0, nan_ok=True)
    torch.testing.assert_close(gradient(weights, found), torch.tensor(expected).double(), equal_nan=True)
