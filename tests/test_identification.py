"""Identification from a log: derivatives against backpropagation, fits against linear regression."""

import math

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from straight_line import Line, Slope, flown, line_segment, noise_of

from rt_torchrl.envs.flapping_wing.closures import QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.figures import identification as charts
from rt_torchrl.fit.identification import (
    Identification,
    IdentificationConfig,
    held_back,
    lag_one,
    measured_states,
)
from rt_torchrl.fit.output_error import InitialStates, OutputError, first_states
from rt_torchrl.fit.resampling import hold_out, resample
from rt_torchrl.fit.sensor_log import SensorLog, checked
from rt_torchrl.fit.simulated_log import policy_law, recorded
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin


@pytest.mark.parametrize("kind", [LinearQuadratic, FlappingWing])
def test_derivatives_are_those_of_backpropagation(kind):
    """By weights and initial states, over segments of different lengths and starts, against the adjoint's."""
    plant = kind() if kind is LinearQuadratic else kind(horizon=0.02)
    generator = torch.Generator().manual_seed(0)
    segments = flown(plant, generator, (12, 7, 20))
    scale = torch.linspace(0.5, 2.0, len(plant.states)).double()
    initial = InitialStates(first_states(segments), range(1, len(plant.states)), scale)
    output_error = OutputError(DigitalTwin(plant, plant.make_closure(generator), engine="autograd"), segments, initial)
    with torch.no_grad():
        initial.offsets.normal_(0.0, 0.1, generator=generator)
    found, cost = output_error.normal_equations(), output_error.cost()
    weights = list(output_error.unknowns.parameters())
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
        segment = second._replace(start=start)
        output_error = OutputError(
            DigitalTwin(plant, QuasiSteadyPolar.true().requires_grad_(True)),
            [segment],
            InitialStates(first_states([segment]), (), torch.ones(4).double()),
        )
        (replayed,) = output_error.replays()
        errors.append((replayed.states - second.states).abs().max().item())
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
    expected = torch.cat([s.states[:, 0] for s in (*training, *held_out)]).numpy()
    assert np.array_equal(drawn, expected)
    shaded = ax.patches[0].get_extents().transformed(ax.transData.inverted())
    end = held_out[0].start + plant.dt * len(held_out[0].actions)
    assert (shaded.x0, shaded.x1) == pytest.approx((held_out[0].start, end))
    bars = charts.weights(found).axes[0]
    assert [label.get_text() for label in bars.get_xticklabels()] == list(found.weights)


def test_measured_initial_states_are_kept_when_asked_for():
    segments = [line_segment(0.05 * np.arange(40) + noise_of(40, 0))]
    config = IdentificationConfig(initial="measured")
    found = Identification(Line(), Slope(), free=(0,), config=config).run(segments, segments)
    for judged in (*found.training, *found.held_out):
        assert judged.states[0][0] == segments[0].states[0]


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
def test_first_order_optimisers_reach_the_same_line(optimiser):
    segments = [line_segment(1.0 + 0.2 * np.arange(40) * 0.1 + 0.1 * noise_of(40, 0), wind=1.0)]
    config = IdentificationConfig(optimiser=optimiser, iterations=30, rate=0.05 if optimiser == "adam" else 1.0)
    found = Identification(Line(), Slope(), free=(0,), config=config).run(segments, segments)
    slope = np.polyfit(0.1 * np.arange(40), segments[0].states[:, 0].numpy(), 1)[0]
    total = sum(entry["after"] for entry in found.weights.values())
    # Their sum is what the record shows; 30 steps of Adam leave some per cent of it.
    assert total == pytest.approx(slope, abs=0.02)
    assert all(math.isinf(entry["standard_error"]) for entry in found.weights.values())


def test_actions_that_the_actuators_would_not_apply_are_told():
    plant = WindTurbine(horizon=20.0)
    (segment,) = flown(plant, torch.Generator().manual_seed(0), (40,))
    assert held_back(plant, [segment]) == {"generator_torque": 0.0, "blade_pitch": 0.0}
    states, actions, exogenous, _ = segment
    jump = actions.clone()
    jump[20:, 1] += 10.0
    # The states remember what was applied before: the pitch may move by 4 deg, and only at step 20 it moved by more;
    # later the remembered pitch is 10 deg behind in every interval.
    share = held_back(plant, [Trajectory(states, jump, exogenous)])
    assert share["generator_torque"] == 0.0 and share["blade_pitch"] == pytest.approx(0.5, abs=0.13)


def test_correlation_of_residuals():
    values = noise_of(5000, 0, smooth=True)
    segments = [line_segment(np.zeros(5000))]
    # Means of neighbours share one of two numbers: 1/2, with a scatter of 1/√5000.
    assert lag_one(Line(), segments, [torch.as_tensor(values).reshape(-1, 1)]).item() == pytest.approx(0.5, abs=0.05)


def test_a_twin_that_diverges_at_the_start_is_told():
    plant = LinearQuadratic(horizon=5.0)
    segments = flown(plant, torch.Generator().manual_seed(0), (50,))
    closure = LinearClosure(torch.full((2, 2), 1e9))
    with pytest.raises(DivergenceError, match="diverged .* at t = .* LinearClosure.* units of what was recorded"):
        Identification(plant, closure, free=(0, 1), config=IdentificationConfig()).run(segments, segments)


@pytest.mark.parametrize("options", [{"iterations": 0}, {"optimiser": "newton"}, {"initial": "guessed"}])
def test_options_out_of_range_are_refused(options, unchecked):
    with pytest.raises(ValueError, match=next(iter(options))):
        IdentificationConfig(**options)


def test_a_log_with_rows_left_out_gives_the_true_weights_within_their_errors():
    """A force that is drawn anew in every interval; in one row of twenty the log does not hold it."""
    plant, generator = LinearQuadratic(horizon=60.0), torch.Generator().manual_seed(3)
    start, wind = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    force = 2.0 * torch.rand(1, plant.n_steps, 1, generator=generator, dtype=torch.float64).round() - 1.0
    with torch.no_grad():
        states = Rollout(plant, plant.closure)(start, wind, force).states[0]
    states = (states + 0.003 * torch.randn(states.shape, generator=generator, dtype=torch.float64)).numpy()[:-1]
    columns = {"position": states[:, 0], "velocity": states[:, 1], "disturbance": wind[0, :, 0].numpy()}
    logged = force[0, :, 0].numpy().copy()
    logged[7::20] = np.nan
    log = SensorLog(times=plant.dt * np.arange(plant.n_steps), columns=columns | {"force": logged})
    parts = resample(checked(log, plant, drop=True), plant)
    found = Identification(plant, LinearClosure(torch.zeros(2, 2)), free=(0, 1), config=IdentificationConfig()).run(
        *hold_out(parts.segments, plant.dt, 0.1)
    )
    for entry, true in zip(found.weights.values(), np.ravel(plant.true_closure), strict=True):
        # The errors are below 0.001; where a force is held over what it was not, they are 0.02.
        assert abs(entry["after"] - true) < 4.0 * entry["standard_error"] < 0.01
