"""First states as unknowns beside the closure's weights, where the first sample is as noisy as any other."""

from pathlib import Path

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from straight_line import Line, Slope, flown, line_segment, noise_of
from torch import nn

from rt_torchrl.fit.least_squares import Estimation
from rt_torchrl.fit.record import sensor_record
from rt_torchrl.fit.sensors import state_sensors
from rt_torchrl.plants.closures import BoundedPerceptron
from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import Assimilation, AssimilationConfig

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
    found = assimilation(Line(), closure).update(records, [], 1, torch.Generator())
    times, X, y = 0.1 * np.arange(101), np.zeros((202, 4)), np.concatenate([r.states[:, 0].numpy() for r in records])
    for k, z in enumerate(WINDS):
        rows = slice(101 * k, 101 * (k + 1))
        X[rows, k], X[rows, 2], X[rows, 3] = 1.0, times, z * times
    solution, residual, *_ = np.linalg.lstsq(X, y, rcond=None)
    # The loop ends where J_p can fall by 1e-8 of it: 1e-4 of a step that would change it by itself.
    np.testing.assert_allclose(closure.w.detach().numpy(), solution[2:], atol=1e-6)
    assert found.best == pytest.approx(0.1 * 0.5 * residual[0] / 2, rel=1e-7)  # mean over the records
    fixed = Slope()
    assimilation(Line(), fixed, initial="measured").update(records, [], 1, torch.Generator())
    # A standard error is 0.03 or so: the pinned start moves the slope by about as much.
    assert (fixed.w - closure.w).abs().max() > 0.02


def test_nothing_is_drawn_from_a_record_without_noise():
    plant = LinearQuadratic()
    (segment,) = flown(plant, torch.Generator().manual_seed(0), (50,))
    closure = plant.make_closure(torch.Generator().manual_seed(1))
    found = assimilation(plant, closure).update([segment], [], 1, torch.Generator())
    assert found.best < 1e-20 * found.start
    # The loop ends at steps of 1e-9, or where little is left to gain.
    torch.testing.assert_close(closure.matrix, torch.tensor(plant.true_closure).double(), rtol=0, atol=1e-7)


@pytest.mark.parametrize("initial", ["measured", "estimated"])
def test_what_is_reported_of_segments_is_the_cost_of_whole_records(initial):
    """J_p has the start that suits the whole record best, which is here a regression on the residuals of the slope."""
    record, closure = lines()[0], Slope()
    found = assimilation(Line(), closure, segment=20, iterations=3, initial=initial)
    found = found.update([record], [], 1, torch.Generator())
    times, x = 0.1 * np.arange(101), record.states[:, 0].numpy()
    for weights, J_p in ((Slope().w, found.start), (closure.w, found.best)):
        left = x - (weights[0] + WINDS[0] * weights[1]).item() * times
        start = left.mean() if initial == "estimated" else left[0]
        assert J_p == pytest.approx(0.1 * 0.5 * ((left - start) ** 2).sum(), rel=1e-7)


class Bent(nn.Module):
    """ẋ = w + g(z), with a perceptron g in reach of the prior."""

    def __init__(self):
        super().__init__()
        self.slope = nn.Parameter(torch.tensor([0.5], dtype=torch.float64))
        self.bend = BoundedPerceptron([(-3.0, 3.0)], [1.0], hidden=(2,), generator=torch.Generator().manual_seed(0))

    def forward(self, features):
        return self.slope + self.bend(features)


def test_the_prior_holds_the_perceptron_and_leaves_the_first_states():
    records, change = lines(), []
    for prior in (0.0, 1e8):
        closure = Bent()
        before = [w.detach().clone() for w in closure.bend.parameters()]
        assimilation(Line(), closure, prior=prior).update(records, [], 1, torch.Generator())
        change.append(max((w - b).abs().max().item() for w, b in zip(closure.bend.parameters(), before, strict=True)))
    assert change[1] < 1e-4 < 1e-2 < change[0]


@pytest.mark.parametrize("options", [{"method": "gradient"}, {"inputs": "realisations"}])
def test_what_first_states_need_is_demanded(options):
    (value,) = options.values()
    with pytest.raises(ValueError, match=f"initial='estimated' .* needs .* {value!r}"):
        assimilation(Line(), Slope(), **options)


class Capped(Slope):
    """ẋ = min(w_0, 1): above one the weight has no effect."""

    def forward(self, features):
        return self.w[:1].clamp(max=1.0).expand_as(features)


def test_the_error_of_a_first_sample_does_not_leave_a_weight_where_it_shows_nowhere():
    """With the first sample, two metres too low, the best slope is above the cap, from where no gradient leads back."""
    values = 0.9 * 0.1 * np.arange(101) + 0.01 * noise_of(101, 0)
    values[0] -= 2.0
    plant, fixed, closure = Line(), Capped(), Capped()
    sensors = state_sensors(plant)
    records = [sensor_record(plant, sensors, line_segment(values))]
    Estimation(DigitalTwin(plant, fixed), sensors, spread=torch.zeros(1).double()).run(records)
    assert fixed.w[0] > 1.0
    Estimation(DigitalTwin(plant, closure), sensors).run(records)
    # The regression holds the wrong sample too: two metres at the end of ten seconds weigh 0.01 m/s or so.
    times = 0.1 * np.arange(101)
    assert closure.w[0].item() == pytest.approx(np.polyfit(times, values, 1)[0], abs=1e-4)
    assert abs(closure.w[0].item() - 0.9) < 0.02


def test_noise_of_the_first_sample_is_no_error_of_the_weights():
    """On the oracle plant, over ten draws of the noise: the error is smaller than with the first sample believed."""
    plant = LinearQuadratic()
    (segment,) = flown(plant, torch.Generator().manual_seed(0), (50,))
    errors = {"measured": 0.0, "estimated": 0.0}
    for seed in range(10):
        noise = 0.05 * torch.randn(51, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        record = segment._replace(states=segment.states + noise)
        for initial in errors:
            closure = LinearClosure(plant.true_closure)
            assimilation(plant, closure, initial=initial).update([record], [], 1, torch.Generator())
            errors[initial] += (closure.matrix - plant.closure.matrix).square().sum().item()
    assert errors["estimated"] < 0.6 * errors["measured"]


@pytest.mark.parametrize("closure", ["paper", "mlp"])
def test_a_tank_with_noisy_sensors_estimates_them_unless_told_otherwise(closure):
    config = load_recipe(Path(__file__).parent.parent / "recipes" / "cryogenic_tank.py").Config
    exact, noisy, told = (
        from_command_line(config, ["--closure", closure, *options]).twinning.assimilation
        for options in ((), ("--noise", "0.01"), ("--noise", "0.01", "--twinning.assimilation.initial", "measured"))
    )
    assert [found.initial for found in (exact, noisy, told)] == ["measured", "estimated", "measured"]
    assert told == exact and noisy.segment == exact.segment
