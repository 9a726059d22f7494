"""Jonkman's controller against the figures known for it on this rotor, and the gain-scheduled policy against both."""

import pytest
import torch
from seeds_and_numbers import double, seeded

from rt_torchrl import StackedObservations
from rt_torchrl.envs.wind_turbine import rosco as adapter
from rt_torchrl.envs.wind_turbine.controllers import GainScheduled, JonkmanController
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.envs.wind_turbine.rosco import RoscoController, nrel5mw, rosco_turbine, steps_of
from rt_torchrl.evaluation.unseen import RealEpisodes
from rt_torchrl.systems.real_system import episode_seed
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


# ROSCO's simulator of the same turbine: against our plant, as a real system, and under ROSCO's own controller.


HORIZON = 60.0


@pytest.fixture(scope="module")
def rosco():
    return pytest.importorskip("rosco")


class Held(torch.nn.Module):
    """A policy with one command for every observation."""

    def forward(self, observation):
        return observation.new_tensor([35e3, 2.0]).expand(*observation.shape[:-1], 2)


def flown(plant, command, seed=0):
    """An episode of ROSCO's simulator under a constant command."""
    system = rosco_turbine(plant, seed=seed)
    held = torch.tensor([command], dtype=torch.float64)
    return system.rollout(plant.n_steps, lambda td: td.set("action", held))[0]


@pytest.mark.parametrize("observe", ["paper", "scheduled"])
def test_our_plant_goes_where_rosco_goes(rosco, observe, monkeypatch):
    """Two codes, one turbine: they part by the error of ROSCO's Euler steps, which is of first order."""
    plant = WindTurbine(horizon=HORIZON, inertia=float(nrel5mw().J), observe=(observe,))
    t, errors = torch.zeros(1, dtype=torch.float64), []
    for step in (0.1, 0.05):
        monkeypatch.setattr(adapter, "STEP", step)
        real = flown(plant, [35e3, 4.0])
        state = real["state"][:1]
        for k in range(plant.n_steps):
            command, wind = real["action"][k : k + 1], real["exogenous"][k : k + 1]
            state = plant.step(t, state, command, wind, plant.closure).state
        errors.append(state[0] - real["next", "state"][-1])
    moved = (real["next", "state"][-1] - real["state"][0]).abs()
    coarse, fine = errors
    assert moved[0] > 0.2 and abs(fine[0]) < 1e-3
    held = [0, 1, 3] if observe == "paper" else [0, 1, 3, 6]
    assert torch.allclose(coarse[held] / fine[held], torch.tensor(2.0).double(), atol=0.1)
    # What is left where the step is taken to zero.
    assert ((2.0 * fine - coarse)[held].abs() < 0.02 * coarse[held].abs()).all()
    assert fine[2].abs() < 1e-4 and (fine[4:6] == 0.0).all()


def test_actuators_are_as_slow_as_the_plants(rosco):
    plant = WindTurbine(horizon=5.0)
    real = flown(plant, [43_000.0, 20.0])
    pitch = real["next", "applied"][:, 1]
    assert torch.allclose(pitch[:5], torch.tensor([4.0, 8.0, 12.0, 16.0, 20.0], dtype=torch.float64))


def test_an_episode_is_known_by_its_seed_and_has_the_plants_wind(rosco):
    plant = WindTurbine(horizon=5.0)
    first, again, other = (flown(plant, [20e3, 0.0], seed) for seed in (1, 1, 2))
    assert torch.equal(first["state"], again["state"]) and not torch.equal(first["state"], other["state"])
    generator = torch.Generator().manual_seed(episode_seed(1, 0))
    plant.draw_initial_state(1, generator)
    assert torch.equal(first["exogenous"], plant.draw_exogenous(1, generator)[0])


@pytest.mark.slow
def test_roscos_controller_holds_the_speed_and_the_power(rosco, capfd):
    """600 s of 11 m/s with 16 % turbulence: some 4.2 MW, as Jonkman's controller, with the speed held at rated."""
    plant = WindTurbine()
    unseen = RealEpisodes(rosco_turbine(plant), 2)
    found = unseen.fly_baseline(RoscoController(plant))
    assert not capfd.readouterr().out  # a banner for every episode would push the progress bar off the terminal
    power = plant.generator_power(found.states[:, :-1], found.actions)
    assert found.states.shape == (2, plant.n_steps + 1, 6)
    assert 3.8e6 < power.mean() < 4.6e6
    speed = plant.gear_ratio * found.states[..., 0]
    assert 100.0 < speed.mean() < 125.0 and speed.max() < 1.2 * plant.rated_generator_speed
    # The same winds as a policy gets.
    other = unseen.fly(Held())
    assert torch.equal(other.exogenous, found.exogenous)
    assert torch.equal(other.states[:, 0, 0], found.states[:, 0, 0])


def test_the_controllers_side_remembers_as_a_step_of_the_plant_does():
    """Answers to a simulator whose rotor stands still in what it reports; the wind is the plant's draw."""
    plant = StackedObservations(WindTurbine(horizon=5.0), 2)
    generator = torch.Generator().manual_seed(3)
    start = plant.draw_initial_state(1, generator)[0]
    wind = plant.draw_exogenous(1, generator)[0, :, 0].numpy()
    every, seen = steps_of(plant), []

    def decide(state, now, report):
        t = torch.tensor(len(seen) * plant.dt, dtype=torch.float64)
        seen.append(plant.observe(t, state, torch.tensor([now], dtype=torch.float64)))
        return state[4:6]

    answer = adapter.Answer(plant, start, wind, decide, every)
    for k in range(4 * every):
        answer.call_controller({"rot_speed": 1.0 + 0.01 * k, "ws": wind[k // every]})
    n = len(seen[0]) // 3
    for k in range(4):
        expected = torch.cat([seen[max(k - j, 0)][:n] for j in range(3)])
        torch.testing.assert_close(seen[k], expected, rtol=0.0, atol=0.0)
    assert not torch.equal(seen[3][:n], seen[2][:n])
