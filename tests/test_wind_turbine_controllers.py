"""Jonkman's controller against the figures known for it on this rotor, and the gain-scheduled policy against both."""

import pytest
import torch
from seeds_and_numbers import double, seeded

from rt_torchrl.envs.wind_turbine.controllers import GainScheduled, JonkmanController
from rt_torchrl.envs.wind_turbine.plant import FAST_FILTER, WindTurbine
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.trajectory import control_cost


@pytest.fixture(scope="module")
def controller():
    return JonkmanController(WindTurbine())


def test_mean_power_its_deviation_and_top_speed(controller):
    plant, generator = controller.plant, torch.Generator().manual_seed(0)
    winds = plant.draw_exogenous(12, generator)
    flown = controller.fly(plant.draw_initial_state(12, generator), winds)
    merit = plant.merit(flown.states, flown.actions, winds)
    # Known from three other winds of 600 s: 4.20 MW, 1.09 MW and 135 rad/s. Between winds the mean power has a standard
    # deviation of about 0.08 MW and its deviation one of 0.1 MW, so 5 % and 15 % hold means over twelve and three.
    assert merit["mean power [MW]"].mean().item() == pytest.approx(4.20, rel=0.05)
    assert merit["power deviation [MW]"].mean().item() == pytest.approx(1.09, rel=0.15)
    assert merit["top generator speed [rad/s]"].amax().item() == pytest.approx(135.0, rel=0.08)


def test_the_torque_joins_its_regions_continuously(controller):
    calm = torch.zeros(2, dtype=torch.float64)
    for speed in (
        controller.cut_in_speed,
        controller.square_speed,
        controller.slip_speed,
        controller.constant_power_speed,
    ):
        below, above = controller.torque(torch.tensor([speed - 1e-7, speed + 1e-7], dtype=torch.float64), calm)
        # The steepest region has 3e3 N m per rad/s; 2e-7 rad/s are 1e-3 N m.
        assert abs(above - below) < 1e-2
    assert controller.torque(torch.tensor([60.0, 60.0], dtype=torch.float64), calm).tolist() == [0.0, 0.0]


def test_a_steady_wind_above_rated_is_held_at_rated_speed(controller):
    plant = controller.plant
    state = plant.draw_initial_state(1, torch.Generator().manual_seed(0))
    flown = controller.fly(state, torch.full((1, 600, 1), 16.0, dtype=torch.float64))
    # The integral leaves no error; 300 s are eighteen time constants of the rotor.
    assert plant.gear_ratio * flown.states[0, -1, 0].item() == pytest.approx(controller.reference_speed, rel=1e-3)
    power = plant.generator_power(flown.states[:, -2], flown.actions[:, -1]).item()
    assert power == pytest.approx(controller.power, rel=1e-3)


def nominal(plant):
    return GainScheduled(plant, detuning=0.0, generator=seeded())


def observed(plant, omega, beta, rate=0.0):
    """Observation at a fast-filtered speed [rad/s], a pitch [deg] and a speed above the filtered one [rad/s]."""
    state = double(0.0, 0.0, 11.0, 0.0, 0.0, beta, omega)
    state[0] = (omega + rate) / plant.gear_ratio
    return plant.observe(torch.zeros(()).double(), state, double(11.0))


def test_torque_is_the_square_law_far_below_and_constant_power_far_above():
    plant = WindTurbine(observe=("scheduled",))
    policy = nominal(plant)
    # The logistic blend leaves e^-20 of the other region.
    below, above = (policy(observed(plant, omega, 0.0))[0].item() for omega in (100.0, 140.0))
    assert below == pytest.approx(2.332287 * 100.0**2, rel=1e-6)
    assert above == pytest.approx(43_093.55 * 122.9096 / 140.0, rel=1e-6)
    # A pitched blade keeps region 3: at 20 deg the switch lies 20 rad/s lower.
    assert policy(observed(plant, 115.0, 20.0))[0].item() == pytest.approx(43_093.55, rel=1e-6)


@pytest.mark.parametrize(("omega", "rate", "beta"), [(126.0, 0.0, 5.0), (124.5, 0.7, 12.0), (123.0, -0.4, 8.0)])
def test_pitch_moves_by_the_increment_of_the_scheduled_law(omega, rate, beta):
    plant = WindTurbine(observe=("scheduled",))
    push = 1.0787 * 1.570796 * rate + 0.462299 * (omega - 124.5)  # K_P and K_I in degrees
    expected = beta + 0.5 * push / (1.0 + beta / 6.302335)
    # The constants above have seven digits.
    assert nominal(plant)(observed(plant, omega, beta, rate))[1].item() == pytest.approx(expected, rel=1e-5)


def test_commands_stay_in_their_ranges_and_gains_start_detuned():
    plant = WindTurbine(observe=("scheduled",))
    policy = GainScheduled(plant, generator=seeded(3))
    seen = torch.stack([observed(plant, w, b, r) for w in (0.0, 90.0, 200.0) for b in (0.0, 30.0) for r in (-9.0, 9.0)])
    commands = policy(seen)
    for column, action in zip(commands.unbind(-1), plant.actions, strict=True):
        assert column.min() >= action.low and column.max() <= action.high and column.isfinite().all()
    factors = double(*[policy.gains()[name].item() / value for name, value in policy.NOMINAL.items()])
    assert factors.log().abs().max() <= torch.log(double(2.0)) and factors.log().abs().min() > 0.0


def test_instruments_change_nothing_of_the_turbine():
    rich, plain = WindTurbine(horizon=50.0, observe=("scheduled",)), WindTurbine(horizon=50.0)
    state, wind = rich.draw_initial_state(3, seeded()), rich.draw_exogenous(3, seeded())
    low, high = bounds(plain.actions)
    command = low + (high - low) * torch.rand(3, rich.n_steps, 2, generator=seeded(1), dtype=torch.float64)
    found = Rollout(rich, rich.closure)(state, wind, command).states
    expected = Rollout(plain, plain.closure)(state[:, :6], wind, command).states
    # The same operations on the same numbers.
    torch.testing.assert_close(found[..., :6], expected, rtol=1e-13, atol=1e-13)
    # An exact low-pass of a speed that is about linear over an interval. Random commands bend it: by the rotor's time
    # constant of 16 s, some Δt²/8·(1 rad/s²) = 0.03 rad/s within it, which the filter hands on.
    speed, filtered = rich.gear_ratio * found[..., 0], found[..., 6]
    decay = torch.exp(double(-0.5 * FAST_FILTER))
    ramp = (1.0 - decay) / (0.5 * FAST_FILTER)
    exact = decay * filtered[:, :-1] + (ramp - decay) * speed[:, :-1] + (1.0 - ramp) * speed[:, 1:]
    torch.testing.assert_close(filtered[:, 1:], exact, rtol=0.0, atol=0.1)


def test_with_jonkmans_constants_it_flies_as_his_controller():
    plant = WindTurbine(observe=("scheduled",))
    state, wind = plant.draw_initial_state(4, seeded(5)), plant.draw_exogenous(4, seeded(5))
    policy = nominal(plant)
    policy.reference_speed, policy.switch_speed = JonkmanController.reference_speed, 120.0
    flown = Rollout(plant, plant.closure, policy)(state, wind)
    power, expected = (
        plant.merit(f.states, f.actions, wind)["mean power [MW]"]
        for f in (flown, JonkmanController(plant).fly(state, wind))
    )
    # The blend and the incremental integral differ from his table and his integrator.
    torch.testing.assert_close(power, expected, rtol=0.015, atol=0.0)


def test_the_exact_gradient_of_the_gains_is_that_of_finite_differences():
    plant = WindTurbine(horizon=60.0, observe=("scheduled",))
    state, wind = plant.draw_initial_state(2, seeded(2)), plant.draw_exogenous(2, seeded(2)) + 2.0
    policy = GainScheduled(plant, generator=seeded(4))
    rollout = Rollout(plant, plant.closure, policy)

    def cost():
        return control_cost(plant, rollout(state, wind)).mean()

    (gradient,) = torch.autograd.grad(cost(), policy.weights)
    for k in range(len(gradient)):
        values = []
        for step in (1e-5, -1e-5):
            with torch.no_grad():
                policy.weights[k] += step
                values.append(cost().item())
                policy.weights[k] -= step
        # Central differences of a cost of order 0.1: rounding 1e-11, truncation below it but for kinks of the limits.
        assert gradient[k].item() == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-4, abs=1e-8)
    assert gradient.abs().min() > 0.0
