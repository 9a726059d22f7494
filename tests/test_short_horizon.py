"""Planning over short windows on the oracle plant: its targets, its critic and its policies against direct sums."""

import copy

import pytest
import torch
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import seeded

from rt_torchrl.optimisers.descent import Descent, DescentConfig
from rt_torchrl.steps.config import PlannerConfig
from rt_torchrl.steps.plan import make_planner
from rt_torchrl.steps.short_horizon import ShortHorizon
from rt_torchrl.trajectories.trajectory import Scenario, control_cost
from rt_torchrl.trajectories.twin import DigitalTwin

SHORT = {"method": "short_horizon", "window": 10}


def episodes(plant, count, seed):
    return Scenario(plant.draw_initial_state(count, seeded(seed)), plant.draw_exogenous(count, seeded(seed)))


def planner(plant):
    twin = DigitalTwin(plant, plant.closure)
    return ShortHorizon(twin, plant.make_policy(seeded(3)), PlannerConfig(**SHORT), generator=seeded(1))


@pytest.fixture
def constants(monkeypatch):
    """Other constants of the method than its own."""

    def change(**values):
        for name, value in values.items():
            monkeypatch.setattr(ShortHorizon, name, value)

    return change


def test_targets_are_discounted_sums(constants):
    constants(mixing=0.7, discount=0.9)
    plan = planner(LinearQuadratic())
    costs, seen = (torch.rand(3, n, *width, generator=seeded(n)).double() for n, width in ((5, ()), (6, (2,))))
    values = plan.target(seen)[..., 0].detach()
    for b in range(3):
        for k in range(5):
            # By the definition: sums of every length m, weighted by (1 − λ)λ^(m−1), the longest by the rest.
            expected, weight = 0.0, 1.0
            for m in range(1, 5 - k + 1):
                total = sum(0.1 * 0.9**j * costs[b, k + j] for j in range(m)) + 0.9**m * values[b, k + m]
                share = weight * 0.3 if m < 5 - k else weight
                expected, weight = expected + share * total, weight * 0.7
            found = plan._targets(costs, seen)[b, k]
            torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)  # rounding


def test_the_critic_learns_what_the_policy_costs(constants):
    """With a policy that stands still, the critic equals discounted sums over long flights, which it never sees."""
    plant = LinearQuadratic(noise=0.0)
    constants(policy_rate=1e-12, discount=0.9)
    plan = planner(plant)
    for k in range(30):
        plan.sweep(*episodes(plant, 32, k))
    state, inputs = episodes(plant, 200, 1000)
    with torch.no_grad():
        flown = plan.twin.control(plan.policy, state, inputs)
        t = plant.dt * torch.arange(50, dtype=torch.float64)
        costs = plant.running_cost(t, flown.states[:, :-1], flown.actions, inputs)
        true = (0.1 * 0.9 ** torch.arange(50) * costs).sum(-1) / plan.reference
        found = plan.critic(state)[:, 0]
    # A perceptron of 64 units after 150 windows; without γ^n v(e_n) the values would be a third too small.
    assert (found - true).square().mean() < 0.03 * true.var()


def test_it_comes_near_the_best_policy(constants):
    constants(policy_rate=2e-2)
    plant = LinearQuadratic()
    plan, unseen = planner(plant), episodes(plant, 50, 99)

    def cost(policy):
        return control_cost(plant, plan.twin.control(policy, *unseen)).mean()

    before, best = cost(plan.policy).item(), copy.deepcopy(plan.policy)
    optimum = Descent(best, DescentConfig(optimiser="lbfgs", rate=1.0)).run(lambda: cost(best), 30).best
    for k in range(25):
        plan.sweep(*episodes(plant, 16, k))
    # Discounting 50 intervals by 0.98 makes it another problem, close by.
    assert optimum < cost(plan.learner).item() < optimum + 0.1 * (before - optimum)
    assert torch.equal(plan.policy.gain, plant.make_policy(seeded(3)).gain)


class Profit(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous) - 3.0


def test_a_negative_cost_descends_too(constants):
    """A constant changes no optimum. Without it 15 sweeps take the cost from 0.92 to 0.35."""
    plant, unseen = Profit(), episodes(LinearQuadratic(), 50, 99)
    constants(policy_rate=2e-2, discount=0.9)
    plan = planner(plant)
    with torch.no_grad():
        before = plan.twin.cost(plan.learner, *unseen).item()
    for k in range(15):
        plan.sweep(*episodes(plant, 16, k))
    with torch.no_grad():
        assert before > -3.0 + 0.9 and plan.twin.cost(plan.learner, *unseen).item() < -3.0 + 0.4


def test_what_was_learned_goes_on_after_a_plan_is_refused(constants):
    constants(policy_rate=100.0)
    plant = LinearQuadratic()
    policy = plant.make_policy(seeded(3))
    twin = DigitalTwin(plant, plant.closure)
    config = PlannerConfig(iterations=1, **SHORT)
    found = make_planner(twin, policy, config, generator=seeded(1))
    before = copy.deepcopy(policy)
    plan = found.plan(episodes(plant, 8, 0))
    # A step of 100 in a gain of 0.1 is a wild one.
    assert plan.best > plan.start and torch.equal(policy.gain, found.learner.gain)
    policy.load_state_dict(before.state_dict())
    found.refuse()
    assert not torch.equal(found.learner.gain, before.gain)
    found.restart()
    assert torch.equal(found.learner.gain, before.gain)


def test_its_state_is_all_it_goes_on_from():
    plant = LinearQuadratic(horizon=2.0)
    one, other = planner(plant), planner(plant)
    for k in range(3):
        one.sweep(*episodes(plant, 4, k))
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    assert one.sweep(*episodes(plant, 4, 9)) == other.sweep(*episodes(plant, 4, 9))
    assert torch.equal(one.learner.gain, other.learner.gain)


def test_a_window_longer_than_an_episode_is_refused():
    with pytest.raises(ValueError, match="window=10 exceeds the 5 control intervals"):
        planner(LinearQuadratic(horizon=0.5))
