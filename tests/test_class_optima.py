"""What a policy sees decides how near it comes to the limit: optima of classes of policies of turbine and drone.

The limits are the clairvoyant optima of the paper's costs on these eight episodes.
"""

import pytest
import torch

from rt_torchrl import SaturatedMLP
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.envs.wind_turbine.plant import EngineeringCost, WindTurbine
from rt_torchrl.evaluation.limits import exact_optimum
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.plants.policies import SaturatedAffine

LIMIT, LIMIT_OF_DRONE = 0.00509, 6.3582
EPISODES, SEED = 8, 12345


def perceptron(plant):
    return lambda generator: SaturatedMLP(len(plant.observations), plant.actions, hidden=(16, 16), generator=generator)


def optimum(plant, make_policy, *, starts=1, approach=600, iterations=500):
    episodes = UnseenEpisodes(plant, EPISODES, seed=SEED)
    return exact_optimum(
        episodes, make_policy, starts=starts, approach=approach, iterations=iterations, few=EPISODES, polish=100, seed=1
    )


@pytest.mark.nightly
@pytest.mark.parametrize(("observe", "greatest"), [("preview", 1.08), ("measured+wind", 1.95)])
def test_a_small_perceptron_comes_near_the_limit(observe, greatest):
    plant = WindTurbine(observe=(observe,))
    assert LIMIT < optimum(plant, perceptron(plant)).cost <= greatest * LIMIT


@pytest.mark.nightly
def test_a_small_perceptron_of_wind_and_phase_flies_the_drone_at_the_limit():
    plant = FlappingWing(observe=("measured+wind",))
    assert optimum(plant, perceptron(plant), approach=240, iterations=120).cost <= 1.003 * LIMIT_OF_DRONE


@pytest.mark.nightly
def test_an_affine_law_of_the_measured_states():
    plant = WindTurbine(observe=("measured",))

    def affine(generator):
        return SaturatedAffine(len(plant.observations), plant.actions, generator=generator)

    assert optimum(plant, affine, approach=0, iterations=400).cost <= 2.7 * LIMIT


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(5))
def test_the_engineering_task_beats_jonkman_in_all_his_merits(seed):
    """On unseen episodes: his energy, at most 1.5 times his pitch travel, and a fifth less speed above rated."""
    plant = WindTurbine(cost=EngineeringCost(), observe=("measured+wind",))
    episodes = UnseenEpisodes(plant, EPISODES, seed=SEED)
    found = exact_optimum(
        episodes, perceptron(plant), starts=1, approach=300, iterations=200, few=EPISODES, polish=0, seed=seed
    )
    unseen = UnseenEpisodes(plant, 16, seed=999)
    with torch.no_grad():
        ours = unseen.judge(unseen.fly(found.policy)).merit
        his = unseen.judge(unseen.fly_baseline(JonkmanController(plant))).merit
    power, travel, over = (
        ours[name].mean().item() / his[name].mean().item()
        for name in ("mean power [MW]", "pitch travel [deg/s]", "speed above rated [rad/s]")
    )
    assert power >= 1.0 and travel <= 1.5 and over <= 0.8
