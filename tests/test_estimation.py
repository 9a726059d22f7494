"""Estimation from partial and noisy readings: against regression and backpropagation."""

import math

import numpy as np
import pytest
import torch
from linear_quadratic import LinearQuadratic
from printed_commands import blocks, run_code
from small_plants import Line, Slope, flown, line_segment, noise_of
from test_uncertainty import position

from rt_torchrl import DigitalTwin, Measurement, Sensor, sensor_record, sensors_of
from rt_torchrl.fit.least_squares import Estimation, judged
from rt_torchrl.fit.sensors import known_sensors, read, read_slopes, segments


def test_derivatives_are_those_of_backpropagation():
    """Of a nonlinear sensor with a bias, over records of two lengths with holes, against the adjoint's."""
    plant, generator = LinearQuadratic(), torch.Generator().manual_seed(0)
    read_product = lambda plant, t, s, z: s[..., 0] * s[..., 1] + t + z[..., 0]  # noqa: E731
    product = Measurement(symbol="p", name="product", unit="m^2/s", read=read_product)
    sensors = (*sensors_of(plant, ["position"]), Sensor(measurement=product, bias=True))
    twin = DigitalTwin(plant, plant.make_closure(generator), engine="autograd")
    records = [sensor_record(plant, sensors, segment) for segment in flown(plant, generator, (12, 7))]
    records[0].readings[3:5, 0] = math.nan
    spread = torch.tensor([math.inf, 2.0]).double()
    task = Estimation(twin, sensors, spread=spread)
    likelihood = task.likelihood(records, torch.tensor([0.1, 0.3]).double())
    unknowns = list(likelihood.unknowns.parameters())
    with torch.no_grad():
        for x in unknowns[1:]:
            x.normal_(0.0, 0.1, generator=generator)

    first, cost = likelihood.initial(), 0.0
    for k, record in enumerate(records):
        flown_again = twin.replay(first[k : k + 1], record.exogenous[None], record.actions[None], start=record.start)
        t = record.start + plant.dt * torch.arange(len(record.readings)).double()
        inputs = torch.cat([record.exogenous, record.exogenous[-1:]])
        error = read(sensors, plant, t, flown_again.states[0], inputs) + likelihood.biases() - record.readings
        cost = cost + 0.5 * ((error / likelihood.noise).nan_to_num() ** 2).sum()
    cost = cost + 0.5 * (((first - likelihood.initial.guess) / spread) ** 2).sum()
    gradient = torch.cat([g.flatten() for g in torch.autograd.grad(cost, unknowns)])
    found = likelihood.normal_equations()
    # The same derivatives, forward instead of backward.
    assert found.cost.item() == pytest.approx(cost.item(), rel=1e-12)
    assert ((found.gradient - gradient).norm() / gradient.norm()).item() < 1e-9


def test_a_line_with_holes_is_fitted_as_by_regression():
    """Weights, starts, noise level and standard errors of two records of unequal length, against least squares."""
    times, X, y, records = 0.1 * np.arange(60), np.zeros((100, 4)), np.zeros(100), []
    sensors = sensors_of(Line(), ["position"])
    for k, (n, wind) in enumerate(((60, 1.0), (40, -2.0))):
        values = 2.0 + 0.5 * times[:n] + 0.3 * wind * times[:n] + 0.2 * noise_of(n, n)
        record = sensor_record(Line(), sensors, line_segment(values, wind=wind))
        record.readings[5:15] = math.nan
        records.append(record)
        rows = slice(0, 60) if k == 0 else slice(60, 100)
        X[rows, k], X[rows, 2], X[rows, 3], y[rows] = 1.0, times[:n], wind * times[:n], values
    kept = ~np.isin(np.arange(100), [*range(5, 15), *range(65, 75)])
    solution, residual, *_ = np.linalg.lstsq(X[kept], y[kept], rcond=None)
    level = math.sqrt(residual[0] / (80 - 4))
    errors = level * np.sqrt(np.diag(np.linalg.inv(X[kept].T @ X[kept])))
    closure = Slope()
    found = Estimation(DigitalTwin(Line(), closure), sensors).run(records)
    # The descent ends where J can fall by 1e-8 of it; the noise level rests within one per cent.
    np.testing.assert_allclose(list(found.after.values()), solution[2:], atol=1e-3 * errors[2:].min())
    np.testing.assert_allclose(found.initial[:, 0].numpy(), solution[:2], atol=1e-3 * errors[:2].min())
    assert found.noise["position"] == pytest.approx(level, rel=0.01)
    assert judged(found.likelihood).rms.item() == pytest.approx(math.sqrt(residual[0] / 80), rel=1e-6)
    np.testing.assert_allclose(list(found.uncertainty.standard_errors().values()), errors[2:], rtol=0.01)
    np.testing.assert_allclose(found.uncertainty.initial_errors()[:, 0].numpy(), errors[:2], rtol=0.01)


def test_a_plants_own_sensor_of_a_state_reads_as_the_plant_says():
    """A sensor of the position that saturates at half a metre, and one of the velocity that reads it as it is."""

    class Saturating(LinearQuadratic):
        position, velocity = LinearQuadratic.states
        measurements = (
            Measurement.of(position, lambda plant, t, state, exogenous: state[..., 0].clamp(-0.5, 0.5)),
            Measurement.of(velocity),
        )

    plant = Saturating()
    sensors, states = sensors_of(plant, ["position", "velocity"]), torch.tensor([[2.0, 3.0], [0.25, 4.0]]).double()
    given = plant, torch.zeros(2).double(), states, torch.zeros(2, 1).double()
    assert read(sensors, *given).tolist() == [[0.5, 3.0], [0.25, 4.0]]
    slopes = read_slopes(sensors, plant, *(x[None] for x in given[1:]))
    assert slopes[0, :, 0].tolist() == [[0.0, 0.0], [1.0, 0.0]]
    assert list(known_sensors(plant)) == ["position", "velocity"]


def test_the_example_of_the_documentation_runs():
    names = run_code("identify.md", blocks("identify.md", "python")[0])
    estimate, plant = names["estimate"], names["plant"]
    assert estimate.noise["sensed_level"] < 1e-5  # nothing has disturbed the record
    true = plant.closure.named_coefficients()
    for name in ("lower_outlet", "lower_loss", "upper_outlet"):
        assert estimate.after[name] == pytest.approx(true[name].item(), rel=1e-3)


def test_parts_of_a_record_share_no_sample():
    record = sensor_record(Line(), position(), line_segment(np.arange(25.0), start=2.0))
    parts = segments(record, 10, 0.1)
    assert [len(part.actions) for part in parts] == [10, 10, 4]
    assert sum(int(part.seen.sum()) for part in parts) == 25
    assert [part.start for part in parts] == pytest.approx([2.0, 3.0, 4.0])
