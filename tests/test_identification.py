"""Identification from a log: derivatives against backpropagation, fits and errors against linear regression."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from torch import nn

from rt_torchrl.compilation import missing_for_compilation
from rt_torchrl.covariance import covariance, named_values, newey_west, standard_errors
from rt_torchrl.envs.flapping_wing.models import QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.figures import identification as charts
from rt_torchrl.identification import (
    Identification,
    IdentificationConfig,
    held_back,
    lag_one,
    measured_states,
)
from rt_torchrl.memory import Record
from rt_torchrl.misfit import InitialStates, Misfit
from rt_torchrl.plant import Plant
from rt_torchrl.recorder import policy_law, recorded
from rt_torchrl.resampling import Segment, hold_out, resample
from rt_torchrl.signal import Signal
from rt_torchrl.trajectory import DivergenceError, Rollout
from rt_torchrl.twin import DigitalTwin


class Slope(nn.Module):
    """ẋ = w_0, and what a second weight does that only the input shows."""

    def __init__(self):
        super().__init__()
        self.w = nn.Parameter(torch.tensor([0.5, 0.3], dtype=torch.float64))

    def forward(self, features):
        return self.w[:1] + self.w[1:] * features


class Line(Plant):
    """x = x_0 + (w_0 + w_1 z) t: identification is linear regression."""

    name = "line"
    states = (Signal(symbol="x", name="position", unit="m"),)
    actions = (Signal(symbol="a", name="nothing", unit="-", low=-1.0, high=1.0),)
    inputs = (Signal(symbol="z", name="wind", unit="-"),)
    observations = states

    def __init__(self, dt=0.1, horizon=10.0):
        super().__init__(dt=dt, horizon=horizon, closure=Slope())

    def vector_field(self, t, state, action, exogenous, closure):
        return closure(exogenous).expand_as(state)

    def discrepancy(self, state, measured):
        return 0.5 * ((state - measured) ** 2).sum(-1)

    observe = running_cost = draw_initial_state = draw_exogenous = make_closure = None


def line_segment(values, wind=0.0, start=0.0):
    n = len(values) - 1
    exogenous = torch.full((n, 1), wind, dtype=torch.float64)
    return Segment(
        start, Record(torch.as_tensor(values).reshape(-1, 1).double(), exogenous, torch.zeros(n, 1).double())
    )


def noise_of(n, seed, *, smooth=False):
    """White noise of unit deviation, or the mean of neighbours of it."""
    values = np.random.default_rng(seed).normal(size=n + 1)
    return 0.5 * (values[1:] + values[:-1]) if smooth else values[1:]


def regression_error(n, dt, *, smooth):
    """Standard error of the slope of a line through n samples with such noise, by (XᵀX)⁻¹XᵀΩX(XᵀX)⁻¹."""
    X = np.stack([np.ones(n), dt * np.arange(n)], -1)
    omega = np.eye(n)
    if smooth:
        omega = 0.5 * np.eye(n) + 0.25 * (np.eye(n, k=1) + np.eye(n, k=-1))
    inverse = np.linalg.inv(X.T @ X)
    return math.sqrt((inverse @ X.T @ omega @ X @ inverse)[1, 1])


def flown(plant, generator, lengths):
    """Segments of one true episode, cut at these steps, with their starts on its clock."""
    start, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    low, high = (torch.tensor([getattr(a, b) for a in plant.actions]).double() for b in ("low", "high"))
    share = 0.3 + 0.4 * torch.rand(1, plant.n_steps, len(plant.actions), generator=generator, dtype=torch.float64)
    with torch.no_grad():
        found = Rollout(plant, plant.closure)(start, exogenous, low + share * (high - low))
    segments, k = [], 0
    for n in lengths:
        record = Record(found.states[0, k : k + n + 1], exogenous[0, k : k + n], found.actions[0, k : k + n])
        segments.append(Segment(k * plant.dt, record))
        k += n
    return segments


def slope_misfit(segments, free=(0,)):
    plant = Line()
    initial = InitialStates(segments, free, torch.ones(1).double())
    return Misfit(DigitalTwin(plant, Slope()), segments, initial)


@pytest.mark.parametrize("kind", [LinearQuadratic, FlappingWing])
def test_derivatives_are_those_of_backpropagation(kind):
    """By weights and initial states, over segments of different lengths and starts, against the adjoint's."""
    plant = kind() if kind is LinearQuadratic else kind(horizon=0.02)
    generator = torch.Generator().manual_seed(0)
    segments = flown(plant, generator, (12, 7, 20))
    scale = torch.linspace(0.5, 2.0, len(plant.states)).double()
    initial = InitialStates(segments, range(1, len(plant.states)), scale)
    misfit = Misfit(DigitalTwin(plant, plant.make_closure(generator), engine="autograd"), segments, initial)
    with torch.no_grad():
        initial.offsets.normal_(0.0, 0.1, generator=generator)
    found, cost = misfit.normal_equations(), misfit.cost()
    weights = list(misfit.unknowns.parameters())
    gradient = torch.cat([g.flatten() for g in torch.autograd.grad(cost, weights)])
    # The same derivatives, forward instead of backward: rounding over 39 steps.
    assert found.cost.item() == pytest.approx(cost.item(), rel=1e-12)
    assert ((found.gradient - gradient).norm() / gradient.norm()).item() < 1e-9


def test_a_segment_is_replayed_on_the_plants_clock():
    """The drone's wing beat has a phase: the true twin replays a later part only if it starts at its own time."""
    plant = FlappingWing(horizon=0.06)
    _, second = flown(plant, torch.Generator().manual_seed(0), (33, 60))
    errors = []
    for start in (second.start, 0.0):
        segment = Segment(start, second.record)
        misfit = Misfit(
            DigitalTwin(plant, QuasiSteadyPolar.true().requires_grad_(True)),
            [segment],
            InitialStates([segment], (), torch.ones(4).double()),
        )
        (replayed,) = misfit.replays()
        errors.append((replayed.states - second.record.states).abs().max().item())
    assert errors[0] < 1e-12 < 1e-4 < errors[1]


def test_a_line_is_fitted_as_by_regression():
    """Slope of two segments with a common w_0 and their own starts, against least squares by numpy."""
    values = [2.0 + 0.5 * 0.1 * np.arange(n) + noise_of(n, n) for n in (60, 40)]
    segments = [line_segment(v) for v in values]
    plant, closure = Line(), Slope()
    found = Identification(plant, closure, free=(0,), config=IdentificationConfig()).run(segments, segments[1:])
    X = np.zeros((100, 3))
    X[:60, 0], X[60:, 1] = 1.0, 1.0
    X[:, 2] = 0.1 * np.concatenate([np.arange(60), np.arange(40)])
    solution, residual, *_ = np.linalg.lstsq(X, np.concatenate(values), rcond=None)
    # The loop ends where J_p can fall by 1e-8 of it, which is 1e-4 standard errors or so.
    error = found.weights["w[0]"]["standard_error"]
    assert abs(found.weights["w[0]"]["after"] - solution[2]) < 1e-3 * error
    assert found.training[1].J_p == pytest.approx(0.05 * residual[0], rel=1e-7)
    # No wind blew: nothing is known of the second weight, and it stays.
    assert math.isinf(found.weights["w[1]"]["standard_error"])
    assert found.weights["w[1]"]["after"] == found.weights["w[1]"]["before"] == 0.3


@pytest.mark.parametrize("smooth", [False, True])
def test_standard_errors_are_those_of_regression(smooth):
    """Mean over draws of the estimated variance against the exact one, for white and for smoothed noise."""
    n, found = 300, []
    for seed in range(10):
        segment = line_segment(0.5 * 0.1 * np.arange(n) + noise_of(n, seed, smooth=smooth))
        misfit = slope_misfit([segment])
        slope, first = np.polyfit(0.1 * np.arange(n), segment.record.states[:, 0].numpy(), 1)
        with torch.no_grad():
            misfit.twin.closure.w[0] = slope
            misfit.initial.offsets[:] = first - segment.record.states[0]
        found.append(covariance(misfit)[0, 0].item())
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
        noise = 0.02 * torch.randn(clean.record.states.shape, generator=generator, dtype=torch.float64)
        segment = Segment(0.0, clean.record._replace(states=clean.record.states + noise))
        closure = LinearClosure(plant.true_closure)
        task = Identification(plant, closure, free=(0, 1), config=config)
        task._descend(misfit := Misfit(task.twin, [segment], task._initial([segment], (0, 1))), config.iterations)
        estimates.append(closure.matrix.detach().flatten().clone())
        errors.append(torch.tensor(list(standard_errors(misfit).values())))
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
    """Of a = e^w to first order, σ_a = a σ_w."""
    plant = FlappingWing(horizon=0.03)
    segments = flown(plant, torch.Generator().manual_seed(0), (60,))
    closure = QuasiSteadyPolar.true().requires_grad_(True)
    noise = 1e-6 * torch.randn(61, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    noisy = [Segment(0.0, segments[0].record._replace(states=segments[0].record.states + noise))]
    misfit = Misfit(DigitalTwin(plant, closure), noisy, InitialStates(noisy, (), torch.ones(4).double()))
    expected = closure.coefficients.detach() * covariance(misfit).diagonal().sqrt()
    found = standard_errors(misfit)
    assert list(found) == ["a", "b", "c"]
    assert list(found.values()) == pytest.approx(expected.tolist(), rel=1e-9)
    assert list(named_values(LinearClosure(torch.zeros(2, 2)))) == [f"matrix[{i},{j}]" for i in (0, 1) for j in (0, 1)]


@pytest.fixture(scope="module")
def identified():
    """The oracle plant from a log with jitter, a gap and noise."""
    plant, generator = LinearQuadratic(dt=0.05, horizon=15.0, noise=0.5), torch.Generator().manual_seed(3)
    policy = plant.make_policy(generator)
    log = recorded(plant, policy_law(plant, policy), generator, jitter=0.4, noise=0.005)
    log = log.chosen((log.times < 5.0) | (log.times > 5.7))
    parts = resample(log, plant)
    training, held_out = hold_out(parts.segments, plant.dt, 0.25)
    task = Identification(
        plant, plant.make_closure(generator), free=measured_states(plant, log), config=IdentificationConfig()
    )
    return plant, parts, training, held_out, task.run(training, held_out)


def test_the_oracle_plant_is_identified_from_a_jittered_log(identified):
    plant, parts, training, held_out, found = identified
    assert len(parts.gaps) == 1 and len(training) == 2 and len(held_out) == 1 and 0.1 < parts.jitter < 0.25
    true = torch.tensor(plant.true_closure).flatten().tolist()
    for entry, value in zip(found.weights.values(), true, strict=True):
        assert abs(entry["before"] - value) > 0.02
        # Four standard errors, and what linear interpolation takes of a curve: h² times the rate of 1/s² or so.
        assert abs(entry["after"] - value) < 4.0 * entry["standard_error"] + 2.0 * plant.dt**2
    for before, after in (found.training, found.held_out):
        assert after.J_p < 1e-2 * before.J_p
        # What is left is the sensors' noise, 0.5 % of signals of some 0.5.
        assert (after.rms < 0.01).all()
    # Interpolation between two noisy samples shares them: about a quarter, here within ±0.25.
    assert (found.autocorrelation < 0.5).all() and (found.autocorrelation > 0.0).all()


def test_figures_show_the_log_the_twin_and_what_was_held_out(identified):
    plant, _, training, held_out, found = identified
    figure = charts.twin_and_log(plant, [0, 1], training, held_out, found)
    ax = figure.axes[0]
    logged = [line for line in ax.lines if line.get_label() == "log"]
    assert len(logged) == 3
    drawn = np.concatenate([line.get_ydata() for line in logged])
    expected = torch.cat([s.record.states[:, 0] for s in (*training, *held_out)]).numpy()
    assert np.array_equal(drawn, expected)
    shaded = ax.patches[0].get_extents().transformed(ax.transData.inverted())
    end = held_out[0].start + plant.dt * len(held_out[0].record.actions)
    assert (shaded.x0, shaded.x1) == pytest.approx((held_out[0].start, end))
    bars = charts.weights(found).axes[0]
    assert [label.get_text() for label in bars.get_xticklabels()] == list(found.weights)


def test_measured_initial_states_are_kept_when_asked_for():
    segments = [line_segment(0.05 * np.arange(40) + noise_of(40, 0))]
    config = IdentificationConfig(initial="measured")
    found = Identification(Line(), Slope(), free=(0,), config=config).run(segments, segments)
    for judged in (*found.training, *found.held_out):
        assert judged.states[0][0] == segments[0].record.states[0]


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
def test_first_order_optimisers_reach_the_same_line(optimiser):
    segments = [line_segment(1.0 + 0.2 * np.arange(40) * 0.1 + 0.1 * noise_of(40, 0), wind=1.0)]
    config = IdentificationConfig(optimiser=optimiser, iterations=30, rate=0.05 if optimiser == "adam" else 1.0)
    found = Identification(Line(), Slope(), free=(0,), config=config).run(segments, segments)
    slope = np.polyfit(0.1 * np.arange(40), segments[0].record.states[:, 0].numpy(), 1)[0]
    total = sum(entry["after"] for entry in found.weights.values())
    # Their sum is what the record shows; 30 steps of Adam leave some per cent of it.
    assert total == pytest.approx(slope, abs=0.02)
    assert all(math.isinf(entry["standard_error"]) for entry in found.weights.values())


def test_actions_that_the_actuators_would_not_apply_are_told():
    plant = WindTurbine(horizon=20.0)
    (segment,) = flown(plant, torch.Generator().manual_seed(0), (40,))
    assert held_back(plant, [segment]) == {"generator_torque": 0.0, "blade_pitch": 0.0}
    states, exogenous, actions = segment.record
    jump = actions.clone()
    jump[20:, 1] += 10.0
    # The states remember what was applied before: the pitch may move by 4 deg, and only at step 20 it moved by more;
    # later the remembered pitch is 10 deg behind in every interval.
    share = held_back(plant, [Segment(0.0, Record(states, exogenous, jump))])
    assert share["generator_torque"] == 0.0 and share["blade_pitch"] == pytest.approx(0.5, abs=0.13)


def test_correlation_of_residuals():
    values = noise_of(5000, 0, smooth=True)
    segments = [line_segment(np.zeros(5000))]
    # Means of neighbours share one of two numbers: 1/2, with a scatter of 1/√5000.
    assert lag_one(segments, [torch.as_tensor(values).reshape(-1, 1)]).item() == pytest.approx(0.5, abs=0.05)


def test_a_twin_that_diverges_at_the_start_is_told():
    plant = LinearQuadratic(horizon=5.0)
    segments = flown(plant, torch.Generator().manual_seed(0), (50,))
    closure = LinearClosure(torch.full((2, 2), 1e9))
    with pytest.raises(DivergenceError, match="diverged at t = .* LinearClosure"):
        Identification(plant, closure, free=(0, 1), config=IdentificationConfig()).run(segments, segments)


@pytest.mark.parametrize("options", [{"iterations": 0}, {"optimiser": "newton"}, {"initial": "guessed"}])
def test_options_out_of_range_are_refused(options, unchecked):
    with pytest.raises(ValueError, match=next(iter(options))):
        IdentificationConfig(**options)


COMPARISON = """
import sys, torch
sys.path.insert(0, "tests")
from test_identification import *
plant = LinearQuadratic(horizon=5.0)
segments = flown(plant, torch.Generator().manual_seed(0), (30, 20))
twin = DigitalTwin(plant, plant.make_closure(torch.Generator().manual_seed(1)))
initial = InitialStates(segments, (0, 1), torch.ones(2).double())
eager, compiled = (Misfit(twin, segments, initial, compiled=c).normal_equations() for c in (False, True))
# The same sums in another order.
for first, second in zip(eager, compiled, strict=True):
    torch.testing.assert_close(first, second, rtol=1e-11, atol=1e-13)
print("equal")
"""


@pytest.mark.slow
@pytest.mark.skipif(missing_for_compilation() is not None, reason=f"torch.compile lacks {missing_for_compilation()}")
def test_a_compiled_interval_gives_the_same_for_every_length():
    """In a process of its own, because annotations that are checked at run time cannot be compiled."""
    root = Path(__file__).parent.parent
    done = subprocess.run([sys.executable, "-c", COMPARISON], cwd=root, capture_output=True, text=True)
    assert done.stdout.strip() == "equal", done.stderr[-3000:]
