"""Standard errors of identified weights against linear regression and Monte Carlo."""

import math

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from straight_line import Line, Slope, flown, line_segment, noise_of

from rt_torchrl.envs.flapping_wing.closures import QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.fit.covariance import covariance, named_values, newey_west, standard_errors
from rt_torchrl.fit.identification import Identification, IdentificationConfig
from rt_torchrl.fit.output_error import InitialStates, OutputError, first_states
from rt_torchrl.trajectories.twin import DigitalTwin


def regression_error(n, dt, *, smooth):
    """Standard error of the slope of a line through n samples with such noise, by (XᵀX)⁻¹XᵀΩX(XᵀX)⁻¹."""
    X = np.stack([np.ones(n), dt * np.arange(n)], -1)
    omega = np.eye(n)
    if smooth:
        omega = 0.5 * np.eye(n) + 0.25 * (np.eye(n, k=1) + np.eye(n, k=-1))
    inverse = np.linalg.inv(X.T @ X)
    return math.sqrt((inverse @ X.T @ omega @ X @ inverse)[1, 1])


def slope_output_error(segments, free=(0,)):
    plant = Line()
    initial = InitialStates(first_states(segments), free, torch.ones(1).double())
    return OutputError(DigitalTwin(plant, Slope()), segments, initial)


@pytest.mark.parametrize("smooth", [False, True])
def test_standard_errors_are_those_of_regression(smooth):
    """Mean over draws of the estimated variance against the exact one, for white and for smoothed noise."""
    n, found = 300, []
    for seed in range(10):
        segment = line_segment(0.5 * 0.1 * np.arange(n) + noise_of(n, seed, smooth=smooth))
        output_error = slope_output_error([segment])
        slope, first = np.polyfit(0.1 * np.arange(n), segment.states[:, 0].numpy(), 1)
        with torch.no_grad():
            output_error.twin.closure.w[0] = slope
            output_error.initial.offsets[:] = first - segment.states[0]
        found.append(covariance(output_error)[0, 0].item())
    expected = regression_error(n, 0.1, smooth=smooth)
    # A variance from 300 samples and 6 lags scatters by √(2·2·6/300) = 28 %, of which ten draws leave 8 %, half of
    # that in the error; the window takes another few per cent of the correlation and of the trend.
    assert math.sqrt(np.mean(found)) == pytest.approx(expected, rel=0.12)


def test_scatter_over_logs_is_the_standard_error():
    """Monte Carlo on the oracle plant: noise drawn anew, weights fitted anew."""
    plant, config = LinearQuadratic(horizon=4.0), IdentificationConfig(iterations=4)
    (clean,) = flown(plant, torch.Generator().manual_seed(0), (40,))
    estimates, errors = [], []
    for seed in range(12):
        generator = torch.Generator().manual_seed(100 + seed)
        noise = 0.02 * torch.randn(clean.states.shape, generator=generator, dtype=torch.float64)
        segment = clean._replace(states=clean.states + noise, start=0.0)
        closure = LinearClosure(plant.true_closure)
        task = Identification(plant, closure, free=(0, 1), config=config)
        task._descend(output_error := task._output_error([segment], (0, 1)))
        estimates.append(closure.matrix.detach().flatten().clone())
        errors.append(torch.tensor(list(standard_errors(output_error).values())))
    z = (torch.stack(estimates) - torch.tensor(plant.true_closure).double().flatten()) / torch.stack(errors)
    # 48 standard normal numbers, four at a time correlated: their mean square is 1 within 0.4 or so. With 41 samples
    # of two states and 4 lags the errors themselves are low by some 10 %.
    assert 0.5 < (z**2).mean() < 2.2


def test_scores_of_white_noise_sum_to_their_variance():
    scores = torch.randn(20_000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = newey_west(scores)
    # Fourteen lags of 20 000 samples: 2·14·2/3/20 000 is a scatter of 3 %.
    torch.testing.assert_close(found / 20_000, torch.eye(2).double(), rtol=0, atol=0.12)


def test_named_errors_follow_from_those_of_the_logarithms():
    """The standard error of a = e^w is, to first order, σ_a = a σ_w."""
    plant = FlappingWing(horizon=0.03)
    segments = flown(plant, torch.Generator().manual_seed(0), (60,))
    closure = QuasiSteadyPolar.true().requires_grad_(True)
    noise = 1e-6 * torch.randn(61, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    noisy = [segments[0]._replace(states=segments[0].states + noise, start=0.0)]
    output_error = OutputError(
        DigitalTwin(plant, closure), noisy, InitialStates(first_states(noisy), (), torch.ones(4).double())
    )
    expected = closure.coefficients.detach() * covariance(output_error).diagonal().sqrt()
    found = standard_errors(output_error)
    assert list(found) == ["a", "b", "c"]
    assert list(found.values()) == pytest.approx(expected.tolist(), rel=1e-9)
    assert list(named_values(LinearClosure(torch.zeros(2, 2)))) == [f"matrix[{i},{j}]" for i in (0, 1) for j in (0, 1)]
