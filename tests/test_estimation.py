"""Estimation from partial and noisy readings, process noise and drift: against regression and backpropagation."""

import math

import numpy as np
import pytest
import torch
from hidden_wall import Envelope, Room, room_records
from linear_quadratic import LinearQuadratic
from printed_commands import blocks
from straight_line import Line, Slope, flown, line_segment, noise_of
from test_uncertainty import NOISE, position

from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.fit.least_squares import Estimation, EstimationConfig, first_noise
from rt_torchrl.fit.prior import Belief, BeliefPrior
from rt_torchrl.fit.record import chained, sensor_record, usual_initial_state
from rt_torchrl.fit.sensors import Sensor, known_sensors, read, read_slopes, sensors_of
from rt_torchrl.plants.signal import Measurement, Signal
from rt_torchrl.trajectories.twin import DigitalTwin

FAST = EstimationConfig(iterations=30)


def test_derivatives_are_those_of_backpropagation():
    """Of a nonlinear sensor with a bias, over records of two lengths with holes, against the adjoint's."""
    plant, generator = LinearQuadratic(), torch.Generator().manual_seed(0)
    product = Measurement(
        symbol="p", name="product", unit="m^2/s", read=lambda plant, t, s, z: s[..., 0] * s[..., 1] + t + z[..., 0]
    )
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
    found = Estimation(DigitalTwin(Line(), closure), sensors, config=FAST).run(records)
    # The descent ends where J can fall by 1e-8 of it; the noise level rests within one per cent.
    np.testing.assert_allclose(list(found.after.values()), solution[2:], atol=1e-3 * errors[2:].min())
    np.testing.assert_allclose(found.initial[:, 0].numpy(), solution[:2], atol=1e-3 * errors[:2].min())
    assert found.noise["position"] == pytest.approx(level, rel=0.01)
    np.testing.assert_allclose(list(found.uncertainty.standard_errors().values()), errors[2:], rtol=0.01)
    np.testing.assert_allclose(found.uncertainty.initial_errors()[:, 0].numpy(), errors[:2], rtol=0.01)


def test_a_bias_is_told_from_the_state():
    """Two sensors of one position, one of which is off by a constant: the difference of their means."""
    plant, values = Line(), 1.0 + 0.05 * np.arange(50)
    sensors = (*sensors_of(plant, ["position"]), Sensor(measurement=sensors_of(plant, ["position"])[0].measurement))
    sensors = (sensors[0], Sensor(measurement=sensors[1].measurement, noise=0.1, bias=True))
    record = sensor_record(plant, sensors, line_segment(values))
    noise = torch.stack([0.1 * torch.from_numpy(noise_of(50, k)) for k in (0, 1)], -1)
    readings = record.readings + noise + torch.tensor([0.0, 0.7])
    found = Estimation(DigitalTwin(plant, Slope()), sensors).run([record._replace(readings=readings)])
    expected = (readings[:, 1] - readings[:, 0]).mean().item()
    assert found.likelihood.biases()[1].item() == pytest.approx(expected, abs=1e-6)


def test_a_room_is_identified_through_its_air_with_its_uncertainty():
    """The hidden start of the wall is an unknown: 60, 90 and 4 come out, as a fit that guesses it does not find."""
    plant, sensors, records = room_records()
    start = torch.tensor([30.0, 150.0, 8.0])
    closure = Envelope(start)
    found = Estimation(DigitalTwin(plant, closure), sensors, config=FAST).run(records)
    errors = found.uncertainty.standard_errors()
    for name, true in zip(Envelope.names, Envelope.true_coefficients, strict=True):
        assert abs(found.after[name] - true) < 3.0 * errors[name] < 0.1 * true
    assert found.noise["air"] == pytest.approx(0.05, rel=0.15)  # 280 samples: ±4 % is one standard error
    assert ((found.initial[:, 1] - 14.5).abs() < 3.5).all() and not found.uncertainty.warnings()
    known = torch.zeros(2).double()
    guessed = Envelope(start)
    Estimation(DigitalTwin(plant, guessed), sensors, spread=known, config=FAST).run(records)
    wrong = (guessed.coefficients - torch.tensor(Envelope.true_coefficients).double()).abs()
    assert wrong[1] > 10.0 * errors["outdoors"]


def test_the_errors_of_the_room_are_those_over_many_draws():
    """Scatter of 12 fits over their standard errors: 36 numbers of unit mean square, correlated three at a time."""
    z = []
    for seed in range(12):
        plant, sensors, records = room_records(seed, lengths=(150,))
        closure = Envelope(Envelope.true().coefficients)
        found = Estimation(DigitalTwin(plant, closure), sensors, config=FAST).run(records)
        errors = found.uncertainty.standard_errors()
        truths = zip(Envelope.names, Envelope.true_coefficients, strict=True)
        z += [(found.after[name] - true) / errors[name] for name, true in truths]
    assert 0.4 < np.mean(np.square(z)) < 2.2


def test_what_one_sensor_cannot_tell_is_said():
    """Of ẍ only two coefficients follow from x: the velocity may be any combination v + βx, scaled by any factor."""
    plant, generator = LinearQuadratic(noise=0.5), torch.Generator().manual_seed(0)
    sensors = sensors_of(plant, ["position"])
    records = [sensor_record(plant, sensors, segment) for segment in flown(plant, generator, (50,))]
    records = [r._replace(readings=r.readings + 0.01 * torch.randn(51, 1, generator=generator)) for r in records]
    found = Estimation(DigitalTwin(plant, plant.make_closure(generator)), sensors, config=FAST).run(records)
    # The force enters ẍ with a known factor, so that the scale is known and only β is free.
    (message,) = (text for text in found.uncertainty.warnings() if "cannot tell" in text)
    assert "1 combination(s)" in message and "fix 1 of them" in message
    unknown = [name for name, error in found.uncertainty.standard_errors().items() if math.isinf(error)]
    assert unknown == ["matrix[0,0]", "matrix[1,0]", "matrix[1,1]"]


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


@pytest.mark.parametrize(
    "kind, name",
    [(FlappingWing, "error_x"), (FlappingWing, "height"), (WindTurbine, "rotor_speed")],
)
def test_states_and_measurements_of_a_plant_are_sensors(kind, name):
    plant = kind()
    state = usual_initial_state(plant)[None]
    (found,) = read(sensors_of(plant, [name]), plant, torch.zeros(1).double(), state, torch.ones(1, 1).double())[0]
    names = [signal.name for signal in plant.states]
    expected = state[0, names.index(name)].item() if name in names else 5.0  # the way from the origin to the target
    assert found.item() == pytest.approx(expected)


def test_what_cannot_be_estimated_is_refused():
    plant, sensors, records = room_records(lengths=(40,))
    twin, unseen = DigitalTwin(plant, Envelope.true()), records[0]._replace(readings=torch.nan * records[0].readings)
    for wrong, message in (
        (lambda: sensors_of(plant, ["roof"]), r"sensors=\('roof',\) .* choose among air, wall"),
        (lambda: sensors_of(plant, []), "nothing cannot be measured"),
        (lambda: Sensor(measurement=sensors[0].measurement, noise=0.0), "noise=0.0 of sensor 'air'"),
        (lambda: Estimation(twin, sensors, spread=-torch.ones(2).double()), r"spread=\[-1.0, -1.0\]"),
        (lambda: first_noise(sensors, []), r"records=\[\]"),
        (lambda: first_noise(sensors, [unseen]), "sensor 'air' has no sample"),
        (lambda: EstimationConfig(prior=-1.0), "prior=-1.0"),
        (lambda: EstimationConfig(rounds=0), "rounds=0"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()


def test_the_usual_initial_state_is_the_mean_of_draws():
    found = usual_initial_state(Room())
    assert (found - 20.0).abs().max() < 4 * 3.0 / math.sqrt(100)


def test_the_example_of_the_documentation_runs():
    (code,) = blocks("partial_measurements.md", "python")
    names = {}
    exec(code, names)
    found, plant = names["found"], names["plant"]
    assert found.noise["sensed_level"] < 1e-5  # nothing has disturbed the record
    true = plant.closure.named_coefficients()
    for name in ("lower_outlet", "lower_loss", "upper_outlet"):
        assert found.after[name] == pytest.approx(true[name].item(), rel=1e-3)


N, LENGTH, PUSH = 60, 10, 0.5
TIMES = 0.1 * np.arange(N + 1)


def pushed():
    """A line of slope 0.8 (wind 1) that something pushes every second, and its noisy record."""
    jumps = np.zeros(N + 1)
    jumps[LENGTH + 1 :: LENGTH] = PUSH * noise_of(5, 11)
    return jumps, 0.8 * TIMES + np.cumsum(jumps) + NOISE * noise_of(N + 1, 3)


def test_weights_are_those_of_generalised_least_squares():
    """Pushes at the cuts, of known size, are noise with a covariance: x = x_0 + v t + pushes before + noise."""
    _, values = pushed()
    X = np.stack([np.ones(N + 1), TIMES], -1)
    before = np.stack([np.arange(N + 1) > k for k in range(LENGTH, N, LENGTH)], -1).astype(float)
    omega = NOISE**2 * np.eye(N + 1) + PUSH**2 * before @ before.T
    inverse = np.linalg.inv(omega)
    C = np.linalg.inv(X.T @ inverse @ X)
    expected = C @ X.T @ inverse @ values
    record = sensor_record(Line(), position(), line_segment(values, wind=0.0))
    task = Estimation(DigitalTwin(Line(), Slope()), position(), process=torch.tensor([PUSH]).double())
    found = task.run(chained(record, LENGTH, 0.1))
    assert found.after["w[0]"] == pytest.approx(expected[1], abs=1e-6)
    assert found.uncertainty.standard_errors()["w[0]"] == pytest.approx(np.sqrt(C[1, 1]), rel=1e-6)
    assert found.initial[0, 0].item() == pytest.approx(expected[0], abs=1e-6)
    # Believing that nothing pushes, the fit is far surer of itself than it may be.
    sure = Estimation(DigitalTwin(Line(), Slope()), position()).run([record])
    assert sure.uncertainty.standard_errors()["w[0]"] < 0.3 * np.sqrt(C[1, 1])


def test_pushes_are_found_where_they_were():
    jumps, values = pushed()
    record = sensor_record(Line(), position(), line_segment(values))
    task = Estimation(DigitalTwin(Line(), Slope()), position(), process=torch.tensor([PUSH]).double())
    likelihood = task.run(chained(record, LENGTH, 0.1)).likelihood
    found = np.array([push.values.item() * PUSH for push in likelihood.pushes()])
    true = jumps[LENGTH + 1 :: LENGTH]
    # Ten samples of 0.2 on each side of a cut, and a slope that is shared.
    assert np.corrcoef(found, true)[0, 1] > 0.9 and np.abs(found - true).max() < 0.4


class Turning(Line):
    """The line on a circle, whose position is wrapped at the end of every interval."""

    states = (Signal(symbol="x", name="position", unit="rad", low=-math.pi, high=math.pi, periodic=True),)

    def advance(self, t, state, applied, exogenous, closure):
        return self.states[0].wrapped(super().advance(t, state, applied, exogenous, closure))


def test_a_push_across_the_seam_of_an_angle_goes_the_short_way():
    """The first part ends half a turn from zero and 0.05 rad beyond, the second begins 0.05 rad before that place."""
    plant = Turning()
    sensors = sensors_of(plant, ["position"])
    values = 3.13 - 0.5 + 0.5 * TIMES[: 2 * LENGTH + 1]
    record = sensor_record(plant, sensors, line_segment(plant.states[0].wrapped(values)))
    task = Estimation(DigitalTwin(plant, Slope()), sensors, process=torch.tensor([0.01]).double())
    likelihood = task.likelihood(chained(record, LENGTH, 0.1))
    with torch.no_grad():
        likelihood.initial.offsets[0] = 0.05 / likelihood.initial.unit
    (push,) = likelihood.pushes()
    assert push.values.item() == pytest.approx(-5.0)


def test_drifting_weights_are_followed_as_by_a_kalman_filter():
    """Of a linear twin the estimate of every record is the measurement update of the filter."""
    drift, belief, mean, C = 0.2, None, None, None
    closure = Slope()
    for k in range(4):
        slopes = np.array([0.5 + 0.2 * k, 0.3])
        winds = (1.0, -2.0)
        values = [
            (slopes[0] + slopes[1] * z) * TIMES + NOISE * noise_of(N + 1, 10 * k + j) for j, z in enumerate(winds)
        ]
        records = [
            sensor_record(Line(), position(), line_segment(v, wind=z)) for v, z in zip(values, winds, strict=True)
        ]
        prior = None if belief is None else BeliefPrior(closure, belief, drift)
        estimate = Estimation(DigitalTwin(Line(), closure), position()).run(records, prior)
        n = estimate.likelihood.weight_count
        weights = torch.cat([w.detach().flatten() for w in closure.parameters()])
        belief = Belief(weights.clone(), estimate.uncertainty.weights_covariance[:n, :n].clone())
        centred = TIMES - TIMES.mean()
        information, pull = np.zeros((2, 2)), np.zeros(2)
        for v, z in zip(values, winds, strict=True):
            row = np.array([1.0, z])
            information += np.outer(row, row) * (centred @ centred) / NOISE**2
            pull += row * (centred @ v) / NOISE**2
        if mean is not None:
            P = np.linalg.inv(C + drift**2 * np.eye(2))
            information, pull = information + P, pull + P @ mean
        C = np.linalg.inv(information)
        mean = C @ pull
        np.testing.assert_allclose(belief.mean.numpy(), mean, atol=1e-6)
        np.testing.assert_allclose(belief.covariance.numpy(), C, rtol=1e-6)


def test_parts_of_a_record_share_no_sample():
    record = sensor_record(Line(), position(), line_segment(np.arange(25.0), start=2.0))
    parts = chained(record, 10, 0.1)
    assert [len(part.actions) for part in parts] == [10, 10, 4] and [p.follows for p in parts] == [False, True, True]
    assert sum(int(part.seen.sum()) for part in parts) == 25
    assert [part.start for part in parts] == pytest.approx([2.0, 3.0, 4.0])


def test_what_does_not_go_with_process_noise_is_refused():
    record = sensor_record(Line(), position(), line_segment(np.arange(25.0)))
    twin, one = DigitalTwin(Line(), Slope()), torch.ones(1).double()
    parts = chained(record, 10, 0.1)
    for wrong, message in (
        (lambda: Estimation(twin, position()).run(parts), "give the estimation its process noise"),
        (lambda: Estimation(twin, position(), process=one).run(parts[1:]), "begin with a record that follows nothing"),
        (lambda: Estimation(twin, position(), process=0.0 * one), r"process=\[0.0\]"),
        (
            lambda: Estimation(twin, position(), process=one, spread=0.0 * one),
            r"no spread=\[0.0\] may be zero beside it",
        ),
        (lambda: chained(record, 0, 0.1), "length=0"),
        (lambda: BeliefPrior(Slope(), Belief(torch.zeros(2).double(), torch.eye(2).double()), 0.0), "drift=0.0"),
        (lambda: BeliefPrior(Slope(), Belief(torch.zeros(3).double(), torch.eye(3).double()), 1.0), "of 3 weights"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()


def test_first_states_may_be_believed_beside_process_noise():
    """A first state of which something is believed is one more reading of it, of that deviation."""
    _, values = pushed()
    spread = 0.3
    before = np.stack([np.arange(N + 1) > k for k in range(LENGTH, N, LENGTH)], -1).astype(float)
    inverse = np.linalg.inv(NOISE**2 * np.eye(N + 1) + PUSH**2 * before @ before.T)
    X, guess = np.stack([np.ones(N + 1), TIMES], -1), np.array([values[0], 0.0])
    believed = np.diag([1.0 / spread**2, 0.0])
    expected = np.linalg.solve(X.T @ inverse @ X + believed, X.T @ inverse @ values + believed @ guess)
    record = sensor_record(Line(), position(), line_segment(values, wind=0.0))
    given = {"spread": torch.tensor([spread]).double(), "process": torch.tensor([PUSH]).double()}
    found = Estimation(DigitalTwin(Line(), Slope()), position(), **given).run(chained(record, LENGTH, 0.1))
    assert found.after["w[0]"] == pytest.approx(expected[1], abs=1e-6)
    assert found.initial[0, 0].item() == pytest.approx(expected[0], abs=1e-6)


def test_what_no_record_has_told_stays_unknown_in_a_belief():
    """In calm air nothing tells the second slope; then a storm does, as with both records (noise levels aside)."""
    closure = Slope()
    task = Estimation(DigitalTwin(Line(), closure), position())
    calm, storm = (
        sensor_record(Line(), position(), line_segment((0.5 + 0.3 * z) * TIMES + NOISE * noise_of(N + 1, 5), wind=z))
        for z in (0.0, 3.0)
    )
    belief = task.run([calm]).uncertainty.belief()
    assert belief.covariance[1, 1] > 1e7 and belief.covariance[0, 0] < 1.0
    found = task.run([storm], BeliefPrior(closure, belief, 1e-3)).uncertainty
    alone = Estimation(DigitalTwin(Line(), Slope()), position()).run([calm, storm]).uncertainty
    assert found.standard_errors()["w[1]"] == pytest.approx(alone.standard_errors()["w[1]"], rel=0.01)
