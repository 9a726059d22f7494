"""Step 4: first states as unknowns, and records replayed in segments."""

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from seeds_and_numbers import seeded
from small_plants import Line, Slope, flown, line_segment, noise_of

from rt_torchrl import AssimilationConfig, DigitalTwin, PositiveCoefficients, Rollout
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.trajectories.trajectory import batch_of, identification_cost

WINDS = (1.0, -2.0)


def assimilation(plant, closure, **options):
    options = {"inputs": "record", "method": "levenberg_marquardt", "initial": "estimated", "iterations": 30, **options}
    return Assimilation(DigitalTwin(plant, closure), AssimilationConfig(**options))


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
    """A line that bends is no noise, and neither is an exact one; the paper's descent knows measured ones alone."""
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
            rollout = Rollout(plant, closure)
            piece = record.states[None, first : first + 13]
            given = piece[:, 0], record.exogenous[None, part], record.actions[None, part]
            expected.append(identification_cost(plant, rollout(*given, start=first * plant.dt), piece).item())
    segments = batch_of(records).segments(12, plant.dt)
    found = assimilation(plant, closure, initial="measured").likelihood(segments).normal_equations().cost.item()
    assert len(segments.states) == 8 and found == pytest.approx(sum(expected) / 8, rel=1e-12)  # sums in another order


class NamedSlope(PositiveCoefficients):
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
    # A slope that the fit has not reached is off by as much more.
    with torch.no_grad():
        (logarithm,) = closure.parameters()
        off = closure.coefficients.item()
        logarithm.add_(0.01)
        off = closure.coefficients.item() - off
    (wider,) = fit.uncertainty([record]).standard_errors().values()
    assert wider == pytest.approx(off, rel=0.02)
