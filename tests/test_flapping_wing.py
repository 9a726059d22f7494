"""The flapping wing: its forces against a plain numpy reading, its resolution and its costs."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import trapezoid
from seeds_and_numbers import double, seeded

from rt_torchrl.envs.flapping_wing.disturbances import GaussianGust
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.trajectories.rollout import Rollout

# Oracle for the forces of the flapping wing: the paper's formulas read literally, in numpy.


ROOT, LENGTH, CHORD = 0.0225, 0.05, 0.01


def reference_force(t, velocity, amplitude, stroke_angle, headwind):
    """F_x, F_z [N] of wings and body, with the paper's matrices and arc cosine, and a trapezium rule along the span."""
    a, b, c = 1.71, 0.043, 1.595
    beta = np.radians(stroke_angle)
    phase = 2 * np.pi * FREQUENCY * t
    phi = np.radians(amplitude) * np.cos(phase)
    phi_dot = -2 * np.pi * FREQUENCY * np.radians(amplitude) * np.sin(phase)
    alpha = np.radians(45.0) * np.sin(phase)
    R2_beta = np.array([[np.cos(beta), 0, np.sin(beta)], [0, 1, 0], [-np.sin(beta), 0, np.cos(beta)]])
    R3 = np.array([[np.cos(phi), np.sin(phi), 0], [-np.sin(phi), np.cos(phi), 0], [0, 0, 1]])
    R2_alpha = np.array([[np.cos(alpha), 0, -np.sin(alpha)], [0, 1, 0], [np.sin(alpha), 0, np.cos(alpha)]])
    to_wing = R2_alpha @ R3 @ R2_beta
    relative = np.array([velocity[0] + headwind, 0.0, velocity[1]])
    r = np.linspace(ROOT, ROOT + LENGTH, 20_001)
    arm = np.stack([0 * r, r, 0 * r], -1)
    U = np.cross(R2_alpha @ np.array([0.0, 0.0, phi_dot]), arm) + to_wing @ relative
    U[:, 1] = 0.0
    speed = np.linalg.norm(U, axis=1)
    alpha_e = np.arccos(U[:, 2] / speed)
    C_L, C_D = a * np.sin(2 * alpha_e), b + c * (1 - np.cos(2 * alpha_e))
    # A quarter turn from the velocity, to the side from which the chord meets the air.
    lift_direction = np.sign(U[:, :1]) * np.stack([-U[:, 2], 0 * r, U[:, 0]], -1) / speed[:, None]
    chord = 4 * CHORD / np.pi * np.sqrt(np.maximum(0.0, 1 - ((r - ROOT) / LENGTH) ** 2))
    pressure = (0.5 * RHO * chord * speed**2)[:, None]
    strip = pressure * (C_L[:, None] * lift_direction - C_D[:, None] * U / speed[:, None])
    right = to_wing.T @ trapezoid(strip, r, axis=0)
    wings = right + right * np.array([1.0, -1.0, 1.0])
    body = -0.5 * RHO * 5e-4 * np.linalg.norm(relative) * relative
    return (wings + body)[[0, 2]]


MASS, GRAVITY, RHO, FREQUENCY = 3e-3, 9.81, 1.225, 20.0
WEIGHT = MASS * GRAVITY


class Converged(FlappingWing):
    """The plant without the errors of quadrature and floor, for comparisons of formulas."""

    span_nodes = 40
    smallest_airspeed = 1e-9


@pytest.fixture(scope="module")
def plant():
    return FlappingWing()


def flown(plant, duration):
    """Positions every 5e-4 s, under controls and a wind that are held that long however short the plant's step is."""
    coarse = 5e-4
    n, inner = round(duration / coarse), round(coarse / plant.dt)
    t = coarse * torch.arange(n, dtype=torch.float64)
    command = torch.stack([77.0 + 5.0 * torch.sin(3.0 * t), -12.0 + 8.0 * torch.sin(5.0 * t)], -1).unsqueeze(0)
    wind = GaussianGust().draw(1, n, coarse, seeded(4)).unsqueeze(-1)
    rollout = Rollout(plant, plant.closure)
    with torch.no_grad():
        states = rollout(
            plant.draw_initial_state(1, seeded()), wind.repeat_interleave(inner, 1), command.repeat_interleave(inner, 1)
        ).states
    return states[0, ::inner, :2]


# Forces


@pytest.mark.parametrize("model, tolerance", [(Converged, 1e-6), (FlappingWing, 2e-3)])
def test_forces_are_those_of_the_matrices_and_the_arc_cosine(model, tolerance):
    # Relative to the weight or the force, whichever is larger. Converged: the trapezium rule at the tip, a square root,
    # leaves (1/20000)^1.5 = 4e-7. As it flies: near the ends of a stroke the flow turns round somewhere along the wing,
    # which six nodes do not resolve; that lasts a short while and hardly shows in the trajectory, see below.
    plant, rng = model(), np.random.default_rng(1)
    for _ in range(100):
        t, velocity = rng.uniform(0.0, 5.0), rng.uniform(-4.0, 4.0, 2)
        amplitude, angle, wind = rng.uniform(50.0, 88.0), rng.uniform(-30.0, 30.0), rng.uniform(-2.0, 4.0)
        rate = plant.vector_field(
            double(t).squeeze(), double(0.3, -0.2, *velocity), double(amplitude, angle), double(wind), plant.closure
        )
        np.testing.assert_array_equal(rate[:2], velocity)
        expected = reference_force(t, velocity, amplitude, angle, wind)
        error = np.linalg.norm(MASS * (rate[2:].numpy() + [0.0, GRAVITY]) - expected)
        assert error < tolerance * max(WEIGHT, np.linalg.norm(expected))


def test_still_air_on_a_resting_wing_is_differentiable(plant):
    state = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    rate = plant.vector_field(double(0.0).squeeze(), state, double(70.0, 0.0), double(0.0), plant.closure)
    (slope,) = torch.autograd.grad(rate.sum(), state)
    assert rate.isfinite().all() and slope.isfinite().all()


# Resolution in time and along the span


@pytest.mark.parametrize("duration", [0.05, pytest.param(2.0, marks=pytest.mark.slow)])
def test_one_step_per_interval_is_accurate(duration):
    coarse, fine = flown(FlappingWing(horizon=2.0), duration), flown(FlappingWing(dt=5e-5, horizon=2.0), duration)
    assert (coarse - fine).abs().max() < 1e-6  # [m]


@pytest.mark.parametrize("duration", [0.2, pytest.param(2.0, marks=pytest.mark.slow)])
def test_six_elements_are_as_good_as_forty(duration):
    class Forty(FlappingWing):
        span_nodes = 40

    six, forty = flown(FlappingWing(), duration), flown(Forty(), duration)
    assert (six - forty).abs().max() < 1e-5  # [m]


# Closure and policy


def test_first_guess_of_the_polar_is_within_half_of_the_truth(plant):
    truth = plant.closure.coefficients
    guesses = torch.stack([plant.make_closure(seeded(i)).coefficients.detach() for i in range(200)])
    assert ((guesses / truth - 1.0).abs() <= 0.5 + 1e-12).all()
    # Uniform on ±0.5 has the standard deviation 0.289; that of 600 draws errs by 0.006.
    assert (guesses / truth).std() == pytest.approx(1 / math.sqrt(12), abs=0.03)
    torch.testing.assert_close(plant.make_closure(seeded(3)).coefficients, guesses[3], rtol=0, atol=0)
    assert not any(weight.requires_grad for weight in plant.parameters())


# Control problem


@pytest.mark.parametrize(
    "state, cost",
    [
        ((0.0, 0.0, 2.0, 3.0), 25.0),  # seven σ away: no weight on the velocity
        ((5.0, 5.0, 1.0, 2.0), 2.5),
        ((5.71, 5.0, 1.0, 0.0), 0.5 * (0.71**2 + math.exp(-1.0))),
        ((5.0, 4.29, 1.0, 2.0), 0.5 * (0.71**2 + 1.0 + 4.0 * math.exp(-1.0))),
    ],
)
def test_cost(plant, state, cost):
    value = plant.running_cost(double(0.0).squeeze(), double(*state), double(70.0, 0.0), double(1.0))
    assert value.item() == pytest.approx(cost, rel=1e-12)


def test_discrepancy_is_of_positions_only(plant):
    value = plant.discrepancy(double(1.0, 2.0, 9.0, 9.0), double(4.0, 6.0, 0.0, 0.0))
    assert value.item() == 12.5


def test_a_heavier_body_is_moved_by_the_same_forces(plant):
    state, action, wind = double(0.0, 0.0, 0.3, -0.2), double(77.0, -5.0), double(1.0)
    heavier = FlappingWing(mass=1.25 * MASS)
    one, other = (
        p.vector_field(double(0.01).squeeze(), state, action, wind, plant.closure)[2:] for p in (plant, heavier)
    )
    gravity = double(0.0, -GRAVITY)
    torch.testing.assert_close(1.25 * (other - gravity), one - gravity)
