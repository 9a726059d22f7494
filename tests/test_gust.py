"""Headwind of the flapping wing: draws against the mean and the covariance they are meant to have."""

import math

import numpy as np
import pytest
import torch
from seeds_and_numbers import seeded

from rt_torchrl.envs.flapping_wing.disturbances import GaussianGust
from rt_torchrl.envs.flapping_wing.plant import FlappingWing


def test_wind_has_the_mean_and_covariance_of_the_process():
    draws, n, dt = 20_000, 26, 0.2
    gust = GaussianGust(mean=1.5, std=0.8, time_scale=0.9)
    wind = gust.draw(draws, n, dt, seeded()).numpy()
    lag = dt * (np.arange(n)[:, None] - np.arange(n)[None])
    # Standard errors are σ/√N = 0.0057 and at most σ²√(2/N) = 0.0064; four of them.
    np.testing.assert_allclose(wind.mean(0), 1.5, atol=0.023)
    np.testing.assert_allclose(np.cov(wind.T), 0.64 * np.exp(-0.5 * (lag / 0.9) ** 2), atol=0.026)


def test_default_wind_is_the_papers():
    wind = FlappingWing(dt=2.5e-3).draw_exogenous(4000, seeded(2))[:, ::400, 0]
    # One standard error is 0.016 for the mean and 0.022 for the variance, at each of the five times.
    torch.testing.assert_close(wind.mean(0), torch.ones(5, dtype=torch.float64), rtol=0, atol=0.064)
    torch.testing.assert_close(wind.var(0), torch.ones(5, dtype=torch.float64), rtol=0, atol=0.09)
    correlation = torch.corrcoef(wind.T)[0]
    expected = torch.exp(-0.5 * (torch.arange(5, dtype=torch.float64) / 3.0) ** 2)
    torch.testing.assert_close(correlation, expected, rtol=0, atol=0.064)


def test_finer_sampling_is_the_same_gust():
    coarse, fine = (GaussianGust().draw(2, n, 5.0 / n, seeded()) for n in (100, 1000))
    torch.testing.assert_close(fine[:, ::10], coarse, rtol=0, atol=1e-13)


def test_steady_wind():
    wind = GaussianGust(mean=2.0, std=0.0).draw(2, 10, 0.1, seeded())
    torch.testing.assert_close(wind, torch.full((2, 10), 2.0, dtype=torch.float64))


@pytest.mark.parametrize("arguments", [{"mean": math.inf}, {"std": -1.0}, {"time_scale": 0.0}])
def test_bad_gust_raises(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        GaussianGust(**arguments)


@pytest.mark.parametrize("request_", [(0, 10, 0.1), (1, 0, 0.1), (1, 10, 0.0)])
def test_bad_draw_raises(request_):
    with pytest.raises(ValueError, match="must be"):
        GaussianGust().draw(*request_, seeded())
