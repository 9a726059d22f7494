"""Learning curves of the explicit update and of TorchRL's, over ten seeds."""

import numpy as np
import pytest
import torch
from hidden_force import Answer, HiddenForce
from linear_quadratic import LinearGain
from scipy.stats import ks_2samp

from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.algorithm import ReinforcementTwinning
from rt_torchrl.twinning.config import TwinningConfig
from rt_torchrl.twinning.learners import LearnerConfig

EPISODES = 3


def learning_curves(seeds, update, **options):
    """J/J* of trainings of the model-free half from half the optimal gain, after each episode."""
    config = LearnerConfig(return_steps=10, critic_iterations=300, actor_iterations=300, update=update, **options)
    answer, curves = Answer(HiddenForce()), []
    for seed in seeds:
        plant = HiddenForce()
        training = ReinforcementTwinning(
            PlantEnv(plant, seed=1000 + seed),
            DigitalTwin(plant, plant.closure),
            model_free=LinearGain(0.5 * answer.gain),
            model_based=LinearGain(0.5 * answer.gain),
            config=TwinningConfig(arm="model_free", learner=config),
            generator=torch.Generator().manual_seed(seed),
        )
        gains = []
        for _ in range(EPISODES):
            training.episode()
            gains.append(training.policies["model_free"].gain.detach().numpy().copy())
        curves.append([1.0 + answer.excess(gain) for gain in gains])
    return np.array(curves)


@pytest.mark.nightly
@pytest.mark.parametrize("algorithm", ["ddpg", "td3"])
def test_learning_curves_of_ten_seeds_are_those_of_torchrl(algorithm, unchecked):
    expected, same, others = (
        learning_curves(seeds, update, algorithm=algorithm)
        for seeds, update in ((range(10), "torchrl"), (range(10), "explicit"), (range(10, 20), "explicit"))
    )
    for name, curves in {"torchrl": expected, "explicit": same, "explicit, other seeds": others}.items():
        print(f"{algorithm}, {name}: J/J* of ten seeds: medians {np.median(curves, 0)}, last {np.sort(curves[:, -1])}")
    # The same seeds give the same curves: what differs by rounding stays close over a thousand iterations.
    np.testing.assert_allclose(same, expected, rtol=1e-3)
    p = ks_2samp(expected[:, -1], others[:, -1]).pvalue
    print(f"{algorithm}: two-sample Kolmogorov-Smirnov test of the last costs with other seeds: p = {p:.3f}")
    assert p > 0.05
