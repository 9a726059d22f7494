"""Process noise and drift: against generalised least squares and the Kalman filter."""

import math

import numpy as np
import pytest
import torch
from straight_line import Line, Slope, line_segment, noise_of
from test_uncertainty import NOISE, position

from rt_torchrl.fit.least_squares import Estimation
from rt_torchrl.fit.prior import Belief, BeliefPrior
from rt_torchrl.fit.record import chained, sensor_record
from rt_torchrl.fit.sensors import sensors_of
from rt_torchrl.plants.signal import Signal
from rt_torchrl.trajectories.twin import DigitalTwin

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
