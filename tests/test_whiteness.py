"""Whether what a replay leaves over is white noise."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from small_runs import SMALL

from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.algorithm import ReinforcementTwinning
from rt_torchrl.twinning.evidence.whiteness import whiteness


def noise(n, signals, seed=0):
    return torch.randn(n, signals, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_it_is_the_test_of_ljung_and_box():
    from scipy.stats import chi2

    e = noise(200, 1)
    centred = (e - e.mean())[:, 0].numpy()
    Q = sum((centred[k:] @ centred[:-k] / (centred @ centred)) ** 2 / (200 - k) for k in range(1, 8)) * 200 * 202
    assert whiteness(e, e, lags=7) == pytest.approx(chi2.sf(Q, 7))


def test_white_noise_is_found_white_as_often_as_the_probability_says():
    found = [whiteness(noise(300, 3, seed), noise(300, 3, seed)) for seed in range(200)]
    share = sum(p < 0.1 for p in found) / len(found)
    assert share == pytest.approx(0.1, abs=0.06)  # 2.8 standard errors; Bonferroni keeps below


def test_a_slow_error_is_not_white_and_rounding_is_nothing():
    read = noise(400, 2)
    slow = 0.1 * torch.sin(torch.linspace(0.0, 9.0, 400, dtype=torch.float64)).unsqueeze(-1).expand(-1, 2)
    assert whiteness(noise(400, 2, 1) + slow, read) > 1e-6 > whiteness(0.1 * noise(400, 2, 1) + slow, read)
    assert whiteness(1e-9 * slow, read) == 1.0
    assert whiteness(slow * torch.inf, read) == 0.0


def test_shapes_that_differ_are_refused():
    with pytest.raises(ValueError, match=r"residuals of shape \(20, 1\) must have that of the signals, \(20, 2\)"):
        whiteness(noise(20, 1), noise(20, 2))
    with pytest.raises(ValueError, match="ten samples"):
        whiteness(noise(9, 1), noise(9, 1))


@pytest.mark.parametrize(("horizon", "tested"), [(0.8, False), (2.0, True)])
def test_an_episode_too_short_for_the_test_is_examined_without_it(horizon, tested):
    plant, generator = LinearQuadratic(horizon=horizon), torch.Generator().manual_seed(0)
    policies = {role: plant.make_policy(generator) for role in ("model_free", "model_based")}
    twin = DigitalTwin(plant, plant.make_closure(generator))
    algorithm = ReinforcementTwinning(PlantEnv(plant, seed=0), twin, **policies, config=SMALL, generator=generator)
    report = algorithm.episode()
    assert "alarm" in report and ("whiteness" in report) == tested
