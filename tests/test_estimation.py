"""Estimation from partial and noisy readings, and step 4: against regression and backpropagation."""

import math

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from printed_commands import blocks, run_code
from seeds_and_numbers import seeded
from small_plants import Line, Slope, flown, line_segment, noise_of
from test_uncertainty import position

import rt_torchrl as rt
from rt_torchrl.fit.least_squares import Estimation, judged
from rt_torchrl.fit.sensors import known_sensors, read, read_slopes, scatter_of, segments
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.trajectories.trajectory import batch_of, identification_cost


def test_derivatives_are_those_of_backpropagation():
    """Of a nonlinear sensor with a bias, over records of two lengths with holes, against the adjoint's.

    The sensor reads the input. That of the last sample is known of the second record alone.
    """
    plant, generator = LinearQuadratic(), torch.Generator().manual_seed(0)
    read_product = lambda plant, t, s, z: s[..., 0] * (s[..., 1] + z[..., 0]) + t  # noqa: E731
    product = rt.Measurement(symbol="p", name="product", unit="m^2/s", read=read_product)
    sensors = (*rt.sensors_of(plant, ["position"]), rt.Sensor(measurement=product, bias=True))
    twin = rt.DigitalTwin(plant, plant.make_closure(generator), engine="autograd")
    records = [rt.sensor_record(plant, sensors, segment) for segment in flown(plant, generator, (12, 7))]
    records[0].readings[3:5, 0] = math.nan
    assert [record.readings[-1].isnan().tolist() for record in records] == [[False, True]] * 2
    records[1].exogenous[-1], records[1].readings[-1, 1] = 0.7, 0.2
    spread = torch.tensor([math.inf, 2.0]).double()
    task = Estimation(twin, sensors, spread=spread)
    likelihood = task.likelihood(records, torch.tensor([0.1, 0.3]).double())
    unknowns = list(likelihood.unknowns.parameters())
    with torch.no_grad():
        for x in unknowns[1:]:
            x.normal_(0.0, 0.1, generator=generator)

    first, cost = likelihood.initial(), 0.0
    for k, record in enumerate(records):
        flown_again = twin.replay(
            first[k : k + 1], record.exogenous[None, :-1], record.actions[None], start=record.start
        )
        t = record.start + plant.dt * torch.arange(len(record.readings)).double()
        inputs = record.exogenous.nan_to_num()  # where it is not known there is no reading
        error = read(sensors, plant, t, flown_again.states[0], inputs) + likelihood.biases() - record.readings
        cost = cost + 0.5 * ((error / likelihood.noise).nan_to_num() ** 2).sum()
    cost = cost + 0.5 * (((first - likelihood.initial.guess) / spread) ** 2).sum()
    gradient = torch.cat([g.flatten() for g in torch.autograd.grad(cost, unknowns)])
    found = likelihood.normal_equations()
    # The same derivatives, forward instead of backward.
    assert found.cost.item() == pytest.approx(cost.item(), rel=1e-12)
    assert ((found.gradient - gradient).norm() / gradient.norm()).item() < 1e-9
    assert [bool(readings[-1, 1].isnan()) for readings in likelihood.simulated()] == [True, False]
    with pytest.raises(ValueError, match="record 0 has 12 actions, 13 readings and 12 exogenous inputs; it must have"):
        task.run([records[0]._replace(exogenous=records[0].exogenous[:-1])])


def test_samples_that_unknowns_fit_exactly_tell_no_noise_level():
    """Segments of one interval have a sample and an unknown each; the first one has two, which tell the slope."""
    segment, sensors = line_segment(0.1 * np.arange(81) + noise_of(81, 0)), rt.sensors_of(Line(), ["position"])
    task = Estimation(rt.DigitalTwin(Line(), Slope()), sensors, config=rt.EstimationConfig(segment=1))
    with pytest.raises(FloatingPointError, match="81 samples determine 81 unknowns and no level of the noise: measure"):
        task.run([rt.sensor_record(Line(), sensors, segment)])


@pytest.mark.parametrize("periodic", [False, True])
def test_scatter_is_the_standard_deviation_and_not_the_distance_from_the_first_reading(periodic):
    """Of a release from 2, and of an angle that goes over the end of its range."""
    values = 2.0 * np.exp(-0.1 * np.arange(400)) + 0.05 * noise_of(400, 0)
    angle = rt.Signal(symbol="a", name="angle", unit="rad", low=-math.pi, high=math.pi, periodic=periodic)
    readings = torch.from_numpy(angle.wrapped(values + 3.0 * periodic))[:, None]
    record = rt.SensorRecord(readings, readings[1:], readings, readings[0])
    record.readings[5:15] = math.nan
    (scatter,) = scatter_of([rt.Sensor(measurement=rt.Measurement.of(angle))], [record]).tolist()
    assert scatter == pytest.approx(np.delete(values, range(5, 15)).std(), rel=1e-12)


def test_a_line_with_holes_is_fitted_as_by_regression():
    """Weights, starts, noise level and standard errors of two records of unequal length, against least squares."""
    times, X, y, records = 0.1 * np.arange(60), np.zeros((100, 4)), np.zeros(100), []
    sensors = rt.sensors_of(Line(), ["position"])
    for k, (n, wind) in enumerate(((60, 1.0), (40, -2.0))):
        values = 2.0 + 0.5 * times[:n] + 0.3 * wind * times[:n] + 0.2 * noise_of(n, n)
        record = rt.sensor_record(Line(), sensors, line_segment(values, wind=wind))
        record.readings[5:15] = math.nan
        records.append(record)
        rows = slice(0, 60) if k == 0 else slice(60, 100)
        X[rows, k], X[rows, 2], X[rows, 3], y[rows] = 1.0, times[:n], wind * times[:n], values
    kept = ~np.isin(np.arange(100), [*range(5, 15), *range(65, 75)])
    solution, residual, *_ = np.linalg.lstsq(X[kept], y[kept], rcond=None)
    level = math.sqrt(residual[0] / (80 - 4))
    errors = level * np.sqrt(np.diag(np.linalg.inv(X[kept].T @ X[kept])))
    closure = Slope()
    found = Estimation(rt.DigitalTwin(Line(), closure), sensors).run(records)
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
            rt.Measurement.of(position, lambda plant, t, state, exogenous: state[..., 0].clamp(-0.5, 0.5)),
            rt.Measurement.of(velocity),
        )

    plant = Saturating()
    sensors, states = rt.sensors_of(plant, ["position", "velocity"]), torch.tensor([[2.0, 3.0], [0.25, 4.0]]).double()
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
    record = rt.sensor_record(Line(), position(), line_segment(np.arange(25.0), start=2.0))
    parts = segments(record, 10, 0.1)
    assert [len(part.actions) for part in parts] == [10, 10, 4]
    assert sum(int(part.seen.sum()) for part in parts) == 25
    assert [part.start for part in parts] == pytest.approx([2.0, 3.0, 4.0])


# Step 4: first states as unknowns, and records replayed in segments.


WINDS = (1.0, -2.0)


def assimilation(plant, closure, **options):
    options = {"inputs": "record", "method": "levenberg_marquardt", "initial": "estimated", "iterations": 30, **options}
    return Assimilation(rt.DigitalTwin(plant, closure), rt.AssimilationConfig(**options))


def lines():
    """Two noisy records of a line, each with its own start and wind."""
    times = 0.1 * np.arange(101)
    return [line_segment(3.0 + (0.4 + 0.2 * z) * times + noise_of(101, k), wind=z) for k, z in enumerate(WINDS)]


def test_weights_are_those_of_a_regression_with_a_start_for_each_record():
    records, closure = lines(), Slope()
    found = assimilation(Line(), closure).update(records)
    times, X, y = 0.1 * np.arange(101), np.zeros((202, 4)), np.concatenate([r.states[:, 0].numpy() for r in records])
    for k, z in enumerate(WINDS):
        rows = slice(101 * k, 101 * (k + 1))
        X[rows, k], X[rows, 2], X[rows, 3] = 1.0, times, z * times
    solution, residual, *_ = np.linalg.lstsq(X, y, rcond=None)
    # The loop ends where J_p can fall by 1e-8 of it: 1e-4 of a step that would change it by itself.
    np.testing.assert_allclose(closure.w.detach().numpy(), solution[2:], atol=1e-6)
    assert found.best == pytest.approx(0.1 * 0.5 * residual[0] / 2, rel=1e-7)  # mean over the records
    fixed = Slope()
    assimilation(Line(), fixed, initial="measured").update(records)
    # A standard error is 0.03 or so: the pinned start moves the slope by about as much.
    assert (fixed.w - closure.w).abs().max() > 0.02


@pytest.mark.parametrize("initial", ["measured", "estimated"])
def test_what_is_reported_is_over_the_segments_of_the_fit(initial):
    """Segments begin with what was read before the fit, and with what suits them best after it if that is estimated."""
    record, closure = lines()[0], Slope()
    fit = assimilation(Line(), closure, segment=20, iterations=3, initial=initial)
    found = fit.update([record])
    times, x = 0.1 * np.arange(101), record.states[:, 0].numpy()
    for weights, J_p, free in ((Slope().w, found.start, False), (closure.w, found.best, initial == "estimated")):
        left = x - (weights[0] + WINDS[0] * weights[1]).item() * times
        parts = np.stack([left[20 * k : 20 * k + 21] for k in range(5)])
        parts = parts - (parts.mean(1) if free else parts[:, 0])[:, None]
        assert J_p == pytest.approx(0.1 * 0.5 * (parts**2).sum(1).mean(), rel=1e-7)
    samples = parts if initial == "estimated" else parts[:, 1:]
    assert fit.report() == {"rms/position [m]": pytest.approx(np.sqrt((samples**2).mean()), rel=1e-6)}
    for length, used in ((7, 7), (50, 20)):  # a shorter record shortens no segments of later ones
        fit.update([record.part(0, length, 0.1)])
        assert fit.length == used


def test_noise_of_the_sensors_decides_whether_first_states_are_estimated():
    """A line that bends is no noise, and neither is an exact one. The paper's descent knows measured ones alone, and
    its twin the noise."""
    noisy, times, fits = lines(), 0.1 * np.arange(101), []
    exact = [line_segment(3.0 + (0.4 + 0.2 * z) * times, wind=z) for z in WINDS]
    bent = [line_segment(3.0 + 0.4 * times + 0.05 * times**2, wind=z) for z in WINDS]
    for records, estimates, options in (
        (noisy, True, {}),
        (exact, False, {}),
        (bent, False, {}),
        (noisy, False, {"method": "adam"}),
    ):
        chosen, given = Slope(), Slope()
        fit = assimilation(Line(), chosen, initial=None, **options)
        found = fit.update(records)
        initial = "estimated" if estimates else "measured"
        asked = assimilation(Line(), given, initial=initial, **options).update(records)
        assert fit.estimates == estimates and torch.equal(chosen.w, given.w) and found == asked
        assert fit.twin.noise.tolist() == pytest.approx([1.0 if records is noisy else 0.0], rel=0.2)
        fits.append(fit)
    fits[-1].load_state_dict(fits[0].state_dict())
    assert fits[-1].estimates and fits[-1].rms_errors(noisy).keys() == {"position [m]"}


class Seasonal(LinearQuadratic):
    """A plant whose force comes and goes with the time."""

    def vector_field(self, t, state, action, exogenous, closure):
        return super().vector_field(t, state, action * torch.cos(3.0 * t).unsqueeze(-1), exogenous, closure)


def test_segments_start_at_their_own_time_and_state():
    """Two records of 50 intervals are cut into segments of 12; J_p is the mean of what a loop over them finds."""
    plant, closure = Seasonal(), LinearClosure(torch.zeros(2, 2))
    records, expected = [flown(plant, seeded(seed), (50,))[0] for seed in (0, 1)], []
    for record in records:
        for first in range(0, 48, 12):
            part = slice(first, first + 12)
            rollout = rt.Rollout(plant, closure)
            piece = record.states[None, first : first + 13]
            given = piece[:, 0], record.exogenous[None, part], record.actions[None, part]
            expected.append(identification_cost(plant, rollout(*given, start=first * plant.dt), piece).item())
    segments = batch_of(records).segments(12, plant.dt)
    found = assimilation(plant, closure, initial="measured").likelihood(segments).normal_equations().cost.item()
    assert len(segments.states) == 8 and found == pytest.approx(sum(expected) / 8, rel=1e-12)  # sums in another order


class NamedSlope(rt.PositiveCoefficients):
    """ẋ = w, a slope with a name."""

    names = {"slope": "m/s"}

    def forward(self, features):
        return self.coefficients + 0.0 * features


def test_standard_errors_are_those_of_the_regression_that_step_4_is():
    """Over a record that begins with its first sample, a slope is the only unknown, whose error is σ/√Σt²."""
    plant, generator = Line(), torch.Generator().manual_seed(0)
    closure, times = NamedSlope(torch.tensor([0.5])), 0.1 * np.arange(401)
    noise = 0.05 * torch.randn(401, generator=generator, dtype=torch.float64).numpy()
    noise[0] = 0.0
    fit = assimilation(plant, closure, initial="measured")
    record = line_segment(0.7 * times + noise, wind=0.0)
    fit.update([record])
    (error,) = fit.uncertainty([record]).standard_errors().values()
    assert error == pytest.approx(0.05 / np.sqrt((times**2).sum()), rel=0.25)
    assert fit.rms_errors([record])["position [m]"] == pytest.approx(0.05, rel=0.1)
    # A slope that the fit has not reached is off by as much more, and its residuals, which last, widen the error, too.
    with torch.no_grad():
        (logarithm,) = closure.parameters()
        off = closure.coefficients.item()
        logarithm.add_(0.01)
        off = closure.coefficients.item() - off
    (wider,) = fit.uncertainty([record]).standard_errors().values()
    assert off < wider < 1.05 * off
