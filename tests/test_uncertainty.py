"""Standard errors, simulations and counted intervals, against closed forms and Monte Carlo."""

import dataclasses
import math
import re

import numpy as np
import pytest
import torch
from interval_coverage import CASES, coverage, random_flight
from seeds_and_numbers import double
from small_plants import Line, Slope, line_segment, noise_of
from test_export_recipe import recipe
from torch import nn

from rt_torchrl import DigitalTwin, Estimation, EstimationConfig, Sensor, sensor_record, sensors_of
from rt_torchrl.evaluation.law import asked_features

ROBUST = EstimationConfig(errors="robust")
TIMES = 0.1 * np.arange(81)
NOISE = 0.2


def position():
    return (Sensor(measurement=sensors_of(Line(), ["position"])[0].measurement, noise=NOISE),)


WINDS = (1.0, -2.0)


def record_of(values, wind=0.0):
    return sensor_record(Line(), position(), line_segment(values, wind=wind))


def estimated(*records, closure=None, config=None):
    """The fit of the line to records of its position."""
    twin = DigitalTwin(Line(), closure or Slope())
    return Estimation(twin, position(), config=config or EstimationConfig()).run(records)


def line_estimate():
    slopes = [0.5 + 0.3 * z for z in WINDS]
    return estimated(*(record_of(slopes[k] * TIMES + NOISE * noise_of(81, k), z) for k, z in enumerate(WINDS)))


def exact_covariance():
    """Of the two weights, by (XᵀX)⁻¹σ² with a start for each record."""
    X = np.zeros((162, 4))
    for k, z in enumerate(WINDS):
        rows = slice(81 * k, 81 * (k + 1))
        X[rows, 0], X[rows, 1], X[rows, 2 + k] = TIMES, z * TIMES, 1.0
    return NOISE**2 * np.linalg.inv(X.T @ X)[:2, :2]


def test_errors_and_correlations_are_those_of_regression():
    found, C = line_estimate().uncertainty, exact_covariance()
    np.testing.assert_allclose(found.named_covariance.numpy(), C, rtol=1e-6)
    assert found.correlations()[0, 1].item() == pytest.approx(C[0, 1] / math.sqrt(C[0, 0] * C[1, 1]))
    low, high = found.intervals(0.95)["w[0]"]
    assert (high - low) / 2.0 == pytest.approx(1.959964 * math.sqrt(C[0, 0]))


def test_errors_of_a_law_are_those_of_regression():
    """w_0 + w_1 z where it was seen and beyond."""
    estimate, z = line_estimate(), torch.tensor([[-2.0], [1.0], [7.0]], dtype=torch.float64)
    found = estimate.uncertainty.errors_of(lambda: estimate.likelihood.twin.closure(z)).squeeze(-1)
    X = np.concatenate([np.ones((3, 1)), z], 1)
    np.testing.assert_allclose(found.numpy(), np.sqrt(np.diag(X @ exact_covariance() @ X.T)), rtol=1e-6)


def test_errors_of_biases_are_those_of_regression():
    """Of a second sensor of the position, beside one without bias; alone, it tells nothing of its bias."""
    (first,) = position()
    again = dataclasses.replace(first.measurement, name="again")
    sensors = first, Sensor(measurement=again, noise=2.0 * NOISE, bias=True)
    records = [
        sensor_record(Line(), sensors, line_segment(0.5 * TIMES + NOISE * noise_of(81, k), wind=0.0)) for k in (0, 1)
    ]
    for record in records:
        record.readings[:, 1] += 0.7
    found = Estimation(DigitalTwin(Line(), Slope()), sensors).run(records)
    starts = np.repeat(np.eye(2), 81, 0)
    X = np.concatenate([np.tile(TIMES, 2)[:, None], starts, np.zeros((162, 1))], 1)
    X = np.concatenate([X, (X + [0.0, 0.0, 0.0, 1.0]) / 2.0])  # in units of the noise of the first sensor
    error = NOISE * math.sqrt(np.linalg.inv(X.T @ X)[3, 3])
    assert found.biases["again"] == pytest.approx(0.7, abs=1e-6)
    assert found.uncertainty.bias_errors() == pytest.approx({"position": 0.0, "again": error}, rel=1e-6)
    alone = Estimation(DigitalTwin(Line(), Slope()), sensors[1:])
    records = [record._replace(readings=record.readings[:, 1:]) for record in records]
    assert alone.run(records).uncertainty.bias_errors() == {"again": math.inf}


class InUnits(Slope):
    """The line's law with weights and values in other units."""

    def __init__(self, weights, values):
        super().__init__()
        self.by_weight, self.by_value = torch.tensor(weights).double(), torch.tensor(values).double()
        self.w = nn.Parameter(self.w.detach() / self.by_weight)

    def forward(self, features):
        slope = self.w * self.by_weight
        return slope[:1] + slope[1:] * features

    def named_coefficients(self):
        return dict(zip(("calm", "wind"), self.w * self.by_weight / self.by_value, strict=True))


UNITS = [(1.0, 1.0), (1e6, 1.0), (1.0, 1e6), (1e-9, 1e9), (1e-20, 1.0)]


@pytest.mark.parametrize(
    "weights, values", [*zip(UNITS, UNITS[:1] * 5, strict=True), *zip(UNITS[:1] * 5, UNITS, strict=True)]
)
def test_what_the_data_do_not_say_does_not_depend_on_units(weights, values):
    """Calm air tells nothing of the second slope; one wind tells a sum of both, of which neither is known."""
    slope_error = NOISE * math.sqrt(1.0 / ((TIMES - TIMES.mean()) ** 2).sum())
    for wind, known in ((0.0, slope_error), (2.0, math.inf)):
        x = (0.5 + 0.3 * wind) * TIMES + NOISE * noise_of(81, 0)
        estimate = estimated(record_of(x, wind), closure=InUnits(weights, values))
        found = estimate.uncertainty
        assert (estimate.after["wind"] == estimate.before["wind"]) == (wind == 0.0)  # it keeps its first value
        errors = [error * unit for error, unit in zip(found.standard_errors().values(), values, strict=True)]
        # In the smallest units no step arrives; the error holds the rest of the way to the line of regression.
        slope = np.polyfit(TIMES, x, 1)[0] - wind * 0.3
        left = estimate.after["calm"] * values[0] - slope if wind == 0.0 else 0.0
        assert errors == pytest.approx([math.hypot(known, left), math.inf], rel=1e-6)
        (warning,) = (text for text in found.warnings() if "hardly" not in text)
        assert f"the data do not tell {'wind' if wind == 0.0 else 'calm, wind'}: measure more" in warning
        assert found.correlations()[:, 1].isnan().all()


class Fixed(Slope):
    """The line's law, of which the slope of the wind is fixed."""

    def __init__(self):
        super().__init__()
        self.calm, self.wind = nn.Parameter(self.w[:1].detach()), nn.Parameter(double(0.3), requires_grad=False)
        del self.w

    def forward(self, features):
        return self.calm + self.wind * features

    def named_coefficients(self):
        return {"calm": self.calm[0], "wind": self.wind[0]}


def test_a_coefficient_that_is_fixed_has_no_error():
    uncertainty = estimated(record_of(1.1 * TIMES + NOISE * noise_of(81, 0), 2.0), closure=Fixed()).uncertainty
    slope_error = NOISE * math.sqrt(1.0 / ((TIMES - TIMES.mean()) ** 2).sum())
    assert uncertainty.standard_errors() == pytest.approx({"calm": slope_error, "wind": 0.0})
    assert not uncertainty.warnings()


def test_standard_errors_are_those_of_regression_with_correlated_noise():
    """Mean over draws of the estimated variance against the exact one, (XᵀX)⁻¹XᵀΩX(XᵀX)⁻¹, for smoothed noise."""
    n, found = 300, []
    X = np.stack([np.ones(n), 0.1 * np.arange(n)], -1)
    omega = 0.5 * np.eye(n) + 0.25 * (np.eye(n, k=1) + np.eye(n, k=-1))
    inverse = np.linalg.inv(X.T @ X)
    for seed in range(10):
        record = record_of(0.5 * 0.1 * np.arange(n) + noise_of(n, seed, smooth=True))
        estimate = estimated(record, config=ROBUST)
        found.append(estimate.uncertainty.named_covariance[0, 0].item())
    expected = math.sqrt((inverse @ X.T @ omega @ X @ inverse)[1, 1])
    # A variance from 300 samples and 6 lags scatters by √(2·2·6/300) = 28 %, of which ten draws leave 8 %, half of
    # that in the error; the window takes another few per cent of the correlation and of the trend.
    assert math.sqrt(np.mean(found)) == pytest.approx(expected, rel=0.12)


@pytest.mark.parametrize("size", [0.05, 1e-6])
def test_alike_residuals_are_told_with_their_size_beyond_rounding(size):
    wave = size * np.sin(2.0 * np.pi * TIMES / 2.0)
    notes = " ".join(estimated(record_of(0.5 * TIMES + wave)).warnings())
    found = re.search(r"position \(correlation (0.9\d), RMS (\S+) m\) are alike", notes)
    assert (found is not None) == (size > 1e-3)
    assert found is None or float(found[2]) == pytest.approx(size / math.sqrt(2.0), rel=0.1)


def test_standard_errors_hold_noise_that_drives_the_system():
    """Residuals that keep .9 of the one before, as those of a slow system do: RMS z of 40 estimates of a slope."""
    n, rho, z = 300, 0.9, []
    omega = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    root = np.linalg.cholesky(omega)
    for seed in range(40):
        estimate = estimated(record_of(0.5 * 0.1 * np.arange(n) + root @ noise_of(n, seed)), config=ROBUST)
        z.append((estimate.after["w[0]"] - 0.5) / estimate.uncertainty.standard_errors()["w[0]"])
    # Newey and West without ρ give 2.1.
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_a_simulation_starts_where_its_first_samples_say():
    found, closure = line_estimate(), Slope()
    with torch.no_grad():
        closure.w.copy_(found.likelihood.twin.closure.w)
    values = 3.0 + (0.5 + 0.3 * 1.5) * TIMES + NOISE * noise_of(81, 7)
    task = Estimation(DigitalTwin(Line(), closure), position())
    readings = recipe("cascaded_tanks").simulated(task, found, record_of(values, 1.5), first=20)
    w = found.likelihood.twin.closure.w.detach().numpy()
    slope = w[0] + 1.5 * w[1]
    start = np.mean(values[:20] - slope * TIMES[:20])
    np.testing.assert_allclose(readings[:, 0].numpy(), start + slope * TIMES, atol=1e-6)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["flapping_wing", "cryogenic_tank", "cascaded_tanks", "pendulum", "wind_turbine"])
def test_intervals_hold_the_truth_on_each_plant(name):
    """200 simulations with 1 % of noise of the sensors' scatter."""
    inside, error_over_bound = coverage(CASES[name], simulations=200)
    assert 0.90 <= inside <= 0.98
    assert (error_over_bound[~error_over_bound.isnan()] < 1.5).all()


@pytest.mark.slow
def test_the_errors_of_a_learned_polar_hold_the_truth():
    """A perceptron beside a wrong polar, where four records of 1 % noise went; flat minima make the errors wide."""
    case, generator = CASES["flapping_wing"], torch.Generator().manual_seed(0)
    plant = case.plant()
    sensors, true, held = sensors_of(plant, case.sensors), case.closure(plant), []
    for _ in range(4):
        flown = random_flight(plant, true, generator)
        twin = DigitalTwin(plant, plant.make_neural_closure(generator, (8,)))
        record = sensor_record(plant, sensors, flown)
        noise = 0.01 * record.readings.std(0) * torch.randn(record.readings.shape, generator=generator).double()
        record = record._replace(readings=record.readings + noise)
        found = Estimation(twin, sensors, config=EstimationConfig(iterations=30)).run([record]).uncertainty
        angles = asked_features(twin, [flown])[::97]
        errors = found.errors_of(lambda twin=twin, angles=angles: twin.closure(angles))
        assert errors.median() < 0.1
        held.append((twin.closure(angles) - true(angles)).abs() < 1.96 * errors)
    assert torch.cat(held).double().mean() > 0.95
