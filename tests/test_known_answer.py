"""The model-free half alone on a problem under partial observation whose optimum is known in closed form."""

import numpy as np
import pytest
import torch
from hidden_force import Answer, HiddenForce
from linear_quadratic import LinearGain
from scipy.linalg import solve_discrete_are
from scipy.optimize import root

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.steps.config import LearnerConfig, TwinningConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.trajectory import control_cost
from rt_torchrl.trajectories.twin import DigitalTwin

# All else, prioritised replay among it, is the library's default; so is the recipe of the wind turbine.
LEARNER = LearnerConfig(return_steps=10)


@pytest.fixture(scope="module")
def answer():
    return Answer(HiddenForce())


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_expected_cost_is_the_mean_of_episodes(answer, share):
    plant, generator, count = HiddenForce(), torch.Generator().manual_seed(0), 2000
    policy = LinearGain(share * answer.gain)
    with torch.no_grad():
        start, exogenous = plant.draw_initial_state(count, generator), plant.draw_exogenous(count, generator)
        flown = Rollout(plant, plant.closure, policy)(start, exogenous)
        costs = control_cost(plant, flown)
    error = costs.std().item() / count**0.5
    # The standard error is 0.5 % of the cost; RK4 and the matrix exponential differ by 1e-6.
    expected = answer.cost(share * answer.gain)
    assert error < 0.01 * expected
    assert abs(costs.mean().item() - expected) < 2.0 * error


def test_gradient_is_zero_at_the_optimal_gain(answer):
    gain, h = answer.gain, 1e-4

    def slope(at, i):
        step = h * np.eye(2)[i]
        return (answer.cost(at + step) - answer.cost(at - step)) / (2.0 * h)

    scale = answer.cost(gain)
    # The search stops at 1e-9 of the gain and 1e-15 of the cost, where the cost cannot tell gains closer than 1e-7.
    assert max(abs(slope(gain, i)) for i in range(2)) < 1e-6 * scale
    assert max(abs(slope(0.5 * gain, i)) for i in range(2)) > 0.05 * scale
    # Half the gain has room for the learner: 10 % lies far below where it starts.
    assert 0.25 < answer.excess(0.5 * gain) < 0.35


def test_full_information_costs_what_riccati_says_and_less_than_two_signals(answer):
    weights = answer.F, answer.G, answer.Q, answer.R
    value = solve_discrete_are(*weights)
    gain = np.linalg.solve(answer.R + answer.G.T @ value @ answer.G, answer.G.T @ value @ answer.F)
    long = Answer(HiddenForce(horizon=1e5))
    # The mean over 1e6 intervals, in which the start counts for 1e-5.
    assert long.cost(gain) == pytest.approx(np.trace(value @ answer.W), rel=1e-4)
    assert 0.5 < answer.cost(gain) / answer.cost(answer.gain) < 0.7


def test_the_learners_discount_leaves_room(answer):
    """A learner whose only error is its discount ends within 2 % (measured 1.0 %), so 5 % and 10 % are fair bounds."""
    found = root(answer.policy_gradient, answer.gain[0], args=(LEARNER.discount,))
    assert found.success and 0.0 < answer.excess(found.x) < 0.02


def test_ddpg_ruins_a_clone_of_the_optimum(answer):
    """The paper's learner with both policies at the optimal gain: J/J* = 1.18 in expectation after one episode."""
    plant = HiddenForce()
    found = ReinforcementTwinning(
        PlantEnv(plant, seed=1000),
        DigitalTwin(plant, plant.closure),
        model_free=LinearGain(answer.gain.copy()),
        model_based=LinearGain(answer.gain.copy()),
        config=TwinningConfig(arm="model_free", learner=LEARNER),
        generator=torch.Generator().manual_seed(0),
    )
    found.episode()
    assert answer.excess(found.policies["model_free"].gain.detach().numpy()) > 0.1
