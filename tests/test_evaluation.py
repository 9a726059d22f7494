"""The reference optimum of classes of policies, the gradient check of a run's start, and what cannot be flown."""

import math
from functools import partial

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic, optimal_gain
from scipy.optimize import minimize
from seeds_and_numbers import double
from small_runs import small_run, stepped_cost

from rt_torchrl import SaturatedAffine, SaturatedMLP, StickingActuator
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.envs.wind_turbine.plant import EngineeringCost, WindTurbine
from rt_torchrl.evaluation.optimum import exact_optimum
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.plants.signal import StateBounds
from rt_torchrl.runs.table import results_table
from rt_torchrl.trajectories.engines.interval import Autograd
from rt_torchrl.trajectories.rollout import ENGINES, DivergenceError


def test_excesses_over_bounds_by_hand():
    bounds = StateBounds(LinearQuadratic.states, {"position": (-1.0, 2.0), "velocity": (-math.inf, 0.5)})
    found = bounds.merit(double([9.0, 9.0], [-1.5, 0.5], [2.25, 0.0], [0.0, 1.0], [3.0, 0.0]).unsqueeze(0))
    assert {name: value.item() for name, value in found.items()} == {
        "position outside [%]": 75.0,
        "position beyond [m]": 1.0,
        "velocity outside [%]": 25.0,
        "velocity beyond [m/s]": 0.5,
    }


def random_gain(generator):
    return LinearGain(torch.randn(1, 2, generator=generator, dtype=torch.float64))


def test_a_run_states_the_least_cost_of_its_class(tmp_path):
    run = small_run(tmp_path, episodes=1, unseen=4, reference=True)
    metrics, unseen = run.train(), UnseenEpisodes(LinearQuadratic(horizon=2.0), 4)
    found, better = metrics["summary"]["reference"], metrics["summary"]["better"]

    fine, cost = {"xatol": 1e-6, "fatol": 1e-12}, lambda gain: stepped_cost(unseen, LinearGain(gain[None]))
    least = minimize(cost, optimal_gain(1.0)[0], method="Nelder-Mead", options=fine).fun
    assert found["J_a"] == pytest.approx(least, rel=1e-6) and found["J_a"] <= found["J_a_by_gradients"]
    mean = metrics["summary"]["unseen"][f"J_a_{better}"]["mean"]
    assert found["better_over_reference"] == pytest.approx(mean / found["J_a"]) and mean > found["J_a"]
    assert f"exact gradients on the true plant: J_a {found['J_a']:.5g}" in results_table(metrics)


def test_the_reference_of_a_plant_with_stiction_is_that_of_a_grid_and_not_of_gradients():
    """Gradients do not see where an actuator begins to slip."""
    plant = StickingActuator(LinearQuadratic(noise=0.0), "force", 0.6)
    unseen = UnseenEpisodes(plant, 6)
    found = exact_optimum(unseen, random_gain, starts=2, iterations=25, few=6, polish=10)
    grid = [(k, d) for k in torch.linspace(0.0, 3.0, 31) for d in torch.linspace(0.0, 3.0, 31)]
    best = min(unseen.control_costs(LinearGain([list(map(float, gains))])).mean().item() for gains in grid)
    assert found.cost == unseen.control_costs(found.policy).mean().item() <= 1.01 * best
    assert found.cost < 0.99 * found.by_gradients


EPISODES, SEED = 8, 12345


PERCEPTRON = partial(SaturatedMLP, hidden=(16, 16))


def optimum(plant, policy, approach, iterations, *, polish=100, seed=2):
    make = lambda generator: policy(len(plant.observations), plant.actions, generator=generator)  # noqa: E731
    options = {"approach": approach, "iterations": iterations, "polish": polish, "seed": seed}
    return exact_optimum(UnseenEpisodes(plant, EPISODES, seed=SEED), make, starts=1, few=EPISODES, **options)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("kind", "observe", "policy", "effort", "greatest"),
    [
        (WindTurbine, "preview", PERCEPTRON, (600, 500), 0.0055),
        (WindTurbine, "measured+wind", PERCEPTRON, (600, 500), 0.0099),
        (WindTurbine, "measured", SaturatedAffine, (0, 400), 0.0137),
        (FlappingWing, "measured+wind", PERCEPTRON, (240, 120), 6.377),
    ],
)
def test_policies_cost_what_the_page_of_observations_says(kind, observe, policy, effort, greatest):
    assert optimum(kind(observe=(observe,)), policy, *effort).cost <= greatest


class Half(Autograd):
    """An engine whose states are right, and whose gradient is wrong by the half."""

    def end_states(self, *arguments):
        states = super().end_states(*arguments)
        return 0.5 * (states + states.detach())

    def costs(self, *arguments):
        return None


@pytest.mark.parametrize("engine", ["native", "parallel"])
def test_an_engine_whose_gradient_is_another_one_trains_nothing(engine, tmp_path, monkeypatch):
    run = small_run(tmp_path, episodes=1, engine=engine)
    monkeypatch.setitem(ENGINES, engine, Half)
    with pytest.raises(
        ValueError, match=rf"engine='{engine}' gives another gradient .* than 'autograd': .* by \d.*e-01"
    ):
        run.train()
    assert not run.episodes


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(5))
def test_the_engineering_task_beats_jonkman_in_all_his_merits(seed):
    """On unseen episodes: his energy, at most 1.5 times his pitch travel, and a fifth less speed above rated."""
    plant = WindTurbine(cost=EngineeringCost(), observe=("measured+wind",))
    found = optimum(plant, PERCEPTRON, 300, 200, polish=0, seed=seed)
    unseen = UnseenEpisodes(plant, 16, seed=999)
    with torch.no_grad():
        ours, his = (unseen.judge(unseen.fly(law)).merit for law in (found.policy, JonkmanController(plant)))
    names = ("mean power [MW]", "pitch travel [deg/s]", "speed above rated [rad/s]")
    power, travel, over = (ours[name].mean().item() / his[name].mean().item() for name in names)
    assert power >= 1.0 and travel <= 1.5 and over <= 0.8


def test_a_start_under_which_the_plant_diverges_is_a_dear_one():
    unseen, gains = UnseenEpisodes(LinearQuadratic(noise=0.0), 4), iter([1e200, 0.5, 1e200])
    search = {"iterations": 5, "few": 2, "polish": 2}
    found = exact_optimum(unseen, lambda _: LinearGain([[next(gains)] * 2]), starts=2, **search)
    assert found.costs[0] == math.inf and found.cost <= found.by_gradients < math.inf
    with pytest.raises(DivergenceError, match="under each of the 1 first policies"):
        exact_optimum(unseen, lambda _: LinearGain([[next(gains)] * 2]), starts=1, **search)
