"""Regions and bands of curves, against closed forms of regression."""

import math

import numpy as np
import pytest
import torch
from hidden_wall import Envelope, room_records
from straight_line import Line, Slope, line_segment, noise_of
from torch import nn

from rt_torchrl.figures import uncertainty as charts
from rt_torchrl.fit.covariance import standard_errors
from rt_torchrl.fit.curve import band
from rt_torchrl.fit.estimation import Estimation, EstimationConfig
from rt_torchrl.fit.output_error import InitialStates, OutputError
from rt_torchrl.fit.prediction import predict
from rt_torchrl.fit.sensor_record import sensor_record
from rt_torchrl.fit.sensors import Sensor, sensors_of
from rt_torchrl.fit.weight_prior import Belief, BeliefPrior
from rt_torchrl.plants.closures import BoundedPerceptron
from rt_torchrl.trajectories.twin import DigitalTwin

TIMES = 0.1 * np.arange(81)
NOISE = 0.2


def position(noise=NOISE):
    return (Sensor(measurement=sensors_of(Line(), ["position"])[0].measurement, noise=noise),)


def line_estimate(winds=(1.0, -2.0), *, smooth=False, config=None):
    sensors = position()
    records = [
        sensor_record(
            Line(),
            sensors,
            line_segment((0.5 + 0.3 * z) * TIMES + NOISE * noise_of(81, k, smooth=smooth), wind=z),
        )
        for k, z in enumerate(winds)
    ]
    closure = Slope()
    return Estimation(DigitalTwin(Line(), closure), sensors, config=config).run(records)


def exact_covariance(winds=(1.0, -2.0)):
    """Of the two weights, by (XᵀX)⁻¹σ² with a start for each record."""
    X = np.zeros((81 * len(winds), 2 + len(winds)))
    for k, z in enumerate(winds):
        rows = slice(81 * k, 81 * (k + 1))
        X[rows, 0], X[rows, 1], X[rows, 2 + k] = TIMES, z * TIMES, 1.0
    return NOISE**2 * np.linalg.inv(X.T @ X)[:2, :2]


def test_errors_correlations_and_ellipses_are_those_of_regression():
    found, C = line_estimate().uncertainty, exact_covariance()
    np.testing.assert_allclose(found.weights_covariance.numpy(), C, rtol=1e-6)
    assert found.correlations()[0, 1].item() == pytest.approx(C[0, 1] / math.sqrt(C[0, 0] * C[1, 1]))
    boundary = found.ellipse("w[0]", "w[1]", level=0.9).numpy() - found.values.numpy()
    mahalanobis = np.einsum("pi,ij,pj->p", boundary, np.linalg.inv(C), boundary)
    np.testing.assert_allclose(mahalanobis, 4.605, rtol=1e-3)  # the 90 % quantile of χ² with two degrees of freedom
    low, high = found.intervals(0.95)["w[0]"]
    assert (high - low) / 2.0 == pytest.approx(1.959964 * math.sqrt(C[0, 0]))


def test_robust_errors_see_that_neighbours_are_alike():
    """Means of neighbours have half the variance of white noise, but sums of them the same: 81 samples, 10 draws."""
    config = EstimationConfig(errors="robust")
    robust = line_estimate(smooth=True, config=config).uncertainty.weights_covariance[0, 0].sqrt().item()
    assert robust == pytest.approx(math.sqrt(exact_covariance()[0, 0]), rel=0.5)


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
        segment = line_segment((0.5 + 0.3 * wind) * TIMES + NOISE * noise_of(81, 0), wind=wind)
        records, closure = [sensor_record(Line(), position(), segment)], InUnits(weights, values)
        found = Estimation(DigitalTwin(Line(), closure), position()).run(records).uncertainty
        errors = [error * unit for error, unit in zip(found.standard_errors().values(), values, strict=True)]
        assert errors == pytest.approx([known, math.inf], rel=1e-6)
        (warning,) = (text for text in found.warnings() if "hardly" not in text)
        assert "the data say nothing of wind" in warning if wind == 0.0 else "calm and wind apart: 1 comb" in warning
        by_cost = OutputError(DigitalTwin(Line(), closure), [segment], InitialStates.as_measured([segment]))
        assert [math.isinf(error) for error in standard_errors(by_cost).values()] == [math.isinf(known), True]
        assert found.correlations()[:, 1].isnan().all()
        # The slope in the wind of the record is known, that in any other wind is not.
        x = torch.tensor([wind, wind + 1.0]).double()
        width = band(found, x, x[:, None])
        assert (width.high - width.low).isinf().tolist() == [False, True]
        with pytest.raises(ValueError, match="has no end, as the data say nothing of them"):
            found.ellipse("calm", "wind")


def test_a_prior_bounds_what_the_data_do_not_say():
    """A belief of the slope in wind from elsewhere is all that is known of it after a record in calm air."""
    closure, generator = Slope(), torch.Generator().manual_seed(0)
    belief = Belief(torch.tensor([0.5, 0.3]).double(), torch.diag(torch.tensor([1.0, 0.04])).double())
    task = Estimation(DigitalTwin(Line(), closure), position())
    values = 0.5 * TIMES + NOISE * torch.randn(81, generator=generator).double().numpy()
    records = [sensor_record(Line(), position(), line_segment(values))]
    found = task.run(records, BeliefPrior(closure, belief, drift=0.15)).uncertainty
    assert found.standard_errors()["w[1]"] == pytest.approx(0.25) and not found.unknown()


def test_a_prediction_in_a_wind_of_which_no_record_tells_has_no_bound():
    task = Estimation(DigitalTwin(Line(), Slope()), position())
    sensors, values = position(), 0.5 * TIMES + NOISE * noise_of(81, 0)
    estimate = task.run([sensor_record(Line(), sensors, line_segment(values))])
    calm, wind = (predict(task, estimate, sensor_record(Line(), sensors, line_segment(values, wind=z))) for z in (0, 1))
    assert calm.deviation.isfinite().all() and wind.deviation[1:].isinf().all()


def test_the_band_of_a_line_is_that_of_regression():
    found = line_estimate()
    x = torch.linspace(-3.0, 3.0, 7).double()
    drawn = band(found.uncertainty, x, x[:, None])
    features = np.stack([np.ones(7), x.numpy()], -1)
    deviation = np.sqrt(np.einsum("pi,ij,pj->p", features, exact_covariance(), features))
    np.testing.assert_allclose(0.5 * (drawn.high - drawn.low).numpy(), 1.959964 * deviation, rtol=1e-5)
    assert drawn.covers(drawn.middle) == 1.0 and drawn.covers(drawn.high + 1.0) == 0.0
    figure = charts.curve(drawn, xlabel="wind", ylabel="slope", data=np.array([1.0, -2.0]), true=drawn.middle.numpy())
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["95 % interval", "twin", "true", "data"]


class Curve(nn.Module):
    """ẋ = g(z), a perceptron."""

    def __init__(self, seed):
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.net = BoundedPerceptron([(-3.0, 3.0), (-1.0, 1.0)], [3.0], hidden=(6,), generator=generator)

    def forward(self, features):
        return self.net(torch.cat([features, torch.zeros_like(features)], -1))


def curve_estimate(seed):
    """A perceptron that learns ẋ = sin z from records in constant winds between −2 and 2."""
    generator, sensors, records = torch.Generator().manual_seed(seed), position(0.02), []
    for z in torch.linspace(-2.0, 2.0, 9).tolist():
        values = math.sin(z) * torch.from_numpy(TIMES[:21]) + 0.02 * torch.randn(21, generator=generator).double()
        records.append(sensor_record(Line(), sensors, line_segment(values.numpy(), wind=z)))
    twin = DigitalTwin(Line(), Curve(seed))
    return Estimation(twin, sensors, config=EstimationConfig(iterations=40, prior=None)).run(records)


@pytest.mark.slow
def test_the_band_of_a_perceptron_widens_where_no_data_was():
    found = curve_estimate(0)
    x = torch.linspace(-3.0, 3.0, 61).double()
    drawn = band(found.uncertainty, x, x[:, None])
    width, inside = drawn.high - drawn.low, x.abs() <= 2.0
    assert width[~inside].max() > 3.0 * width[inside].max()
    # One draw of the noise: the nightly check counts many.
    assert band(found.uncertainty, x[inside], x[inside][:, None]).covers(x[inside].sin()) > 0.7
    assert 1e-6 < found.stiffness < 1e8 and found.stiffness != 1.0


def test_figures_of_regions_show_every_pair():
    plant, sensors, records = room_records(lengths=(150,))
    closure = Envelope(Envelope.true().coefficients)
    found = Estimation(DigitalTwin(plant, closure), sensors).run(records).uncertainty
    shown = charts.correlations(found).axes[0]
    assert [label.get_text() for label in shown.get_xticklabels()] == list(Envelope.names)
    figure = charts.ellipses(found)
    drawn = [ax for ax in figure.axes if ax.lines]
    assert len(drawn) == 3 and drawn[0].lines[1].get_xdata()[0] == pytest.approx(found.values[0].item())
    (without,) = charts.ellipses(line_estimate(winds=(0.0,)).uncertainty).axes
    assert len(without.lines) == 1  # the estimate, as one of the two values has no end


def test_what_makes_no_region_is_refused():
    found = line_estimate()
    for wrong, message in (
        (lambda: found.uncertainty.ellipse("w[0]", "x"), r"ellipse of \['x'\]"),
        (lambda: found.uncertainty.intervals(1.0), "level=1.0"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()
