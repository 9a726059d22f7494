"""Simulations from first samples, residual tests and counted intervals, against closed forms."""

import numpy as np
import pytest
import torch
from interval_coverage import CASES, CURVES, coverage, curves_of
from straight_line import Line, Slope, line_segment, noise_of
from test_export_recipe import recipe
from test_uncertainty import NOISE, TIMES, exact_covariance, line_estimate, position

from rt_torchrl.fit.least_squares import Estimation, EstimationConfig
from rt_torchrl.fit.record import sensor_record
from rt_torchrl.fit.sensors import sensors_of
from rt_torchrl.fit.uncertainty import band
from rt_torchrl.trajectories.twin import DigitalTwin

made = recipe("cascaded_tanks")
Prediction, predict, residual_tests = made.Prediction, made.predict, made.residual_tests


def predicted(first=20):
    """Another record of the line, from a start that its first samples tell."""
    found = line_estimate()
    closure = Slope()
    with torch.no_grad():
        closure.w.copy_(found.likelihood.twin.closure.w)
    values = 3.0 + (0.5 + 0.3 * 1.5) * TIMES + NOISE * noise_of(81, 7)
    record = sensor_record(Line(), position(), line_segment(values, wind=1.5))
    task = Estimation(DigitalTwin(Line(), closure), position())
    return found, values, predict(task, found, record, first=first), record


def test_a_simulation_starts_where_its_first_samples_say():
    found, values, made, _ = predicted()
    w = found.likelihood.twin.closure.w.detach().numpy()
    slope = w[0] + 1.5 * w[1]
    start = np.mean(values[:20] - slope * TIMES[:20])
    np.testing.assert_allclose(made.readings[:, 0].numpy(), start + slope * TIMES, atol=1e-6)
    assert made.rms[0].item() == pytest.approx(np.sqrt(np.mean((values - start - slope * TIMES) ** 2)), abs=1e-6)
    variance = np.array([1.0, 1.5]) @ exact_covariance() @ np.array([1.0, 1.5]) * TIMES**2 + NOISE**2 / 20
    np.testing.assert_allclose(made.deviation[:, 0].numpy(), np.sqrt(variance), rtol=1e-4)


def test_the_interval_of_an_rms_error_holds_it():
    made = predicted()[2]
    low, high = made.rms_interval(5)
    assert low < made.rms[0].item() < high < 2.0 * low
    with pytest.raises(ValueError, match="block=81"):
        made.rms_interval(81)


def test_residuals_that_follow_the_action_are_found():
    """Errors that are the action three samples before, and white noise of the same size."""
    record = predicted()[3]
    n = 400
    action = torch.from_numpy(noise_of(n, 1))[:, None]
    late = torch.cat([torch.zeros(3, 1).double(), action[:-3], action[-1:]])
    white = torch.from_numpy(noise_of(n + 1, 2))[:, None]
    record = record._replace(actions=action, exogenous=action)
    tests = [
        residual_tests(Prediction(0.0 * e, e, e, e[0], e[0]), record, lags=20) for e in (late + 0.5 * white, white)
    ]
    assert tests[0].cross.abs().argmax() == 3 and tests[0].cross[3] > 0.8
    # One in twenty is outside its bound by chance.
    assert (tests[1].cross.abs() > tests[1].bound).sum() <= 4 and (tests[1].auto.abs() > tests[1].bound).sum() <= 4
    assert "outside ±0.098" in tests[0].describe()
    with pytest.raises(ValueError, match="lags=400"):
        residual_tests(Prediction(white, white, white, white[0], white[0]), record, lags=400)


class WindyLine(Line):
    """The line with a wind that is drawn anew every second."""

    def __init__(self):
        super().__init__(horizon=4.0)

    def draw_exogenous(self, batch, generator):
        return torch.randn(batch, 4, 1, generator=generator, dtype=torch.float64).repeat_interleave(10, 1)


def test_intervals_of_a_regression_hold_the_truth():
    plant, truth = WindyLine(), Slope()
    sensors = sensors_of(plant, ["position"])
    generator = torch.Generator().manual_seed(0)
    found = coverage(plant, truth, sensors, simulations=20, share=0.1, generator=generator)
    # Two times 20 intervals: 95 % within 3 · 3.4 %, and a mean square of 1 within 2 · √(2/40).
    assert 0.85 <= found.mean <= 1.0 and found.told.tolist() == [1.0, 1.0]
    assert 0.7 < found.error_over_bound.square().mean().sqrt() < 1.3
    with pytest.raises(ValueError, match="simulations=0"):
        coverage(plant, truth, sensors, simulations=0, generator=generator)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["flapping_wing", "cryogenic_tank", "cascaded_tanks", "pendulum", "wind_turbine"])
def test_intervals_hold_the_truth_on_each_plant(name):
    """200 simulations with 1 % of noise of the sensors' scatter."""
    case = CASES[name]
    plant, generator = case.plant(), torch.Generator().manual_seed(0)
    given = {"config": EstimationConfig(iterations=20), "flights": case.flights}
    found = coverage(plant, case.closure(plant), sensors_of(plant, case.sensors), generator=generator, **given)
    assert 0.90 <= found.mean <= 0.98
    assert (found.error_over_bound[~found.error_over_bound.isnan()] < 1.5).all()


@pytest.mark.nightly
def test_bands_of_a_perceptron_hold_the_curve():
    """Pointwise, where data was, over 100 draws of the noise and of the first weights."""
    from test_uncertainty import curve_estimate

    x = torch.linspace(-2.0, 2.0, 41).double()
    inside = [band(curve_estimate(seed).uncertainty, x, x[:, None]).covers(x.sin()) for seed in range(100)]
    assert np.mean(inside) >= 0.85


@pytest.mark.nightly
@pytest.mark.parametrize("name", CURVES)
def test_bands_of_neural_closures_hold_the_curve(name):
    """C_p, C_L and the outlet of a tank, pointwise where the records have been."""
    assert curves_of(CURVES[name], 20, 0.01, 0).mean() >= 0.85
