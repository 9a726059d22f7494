"""ROSCO's simulator of the same turbine: against our plant, as a real system, and under ROSCO's own controller."""

import pytest
import torch

from rt_torchrl import StackedObservations
from rt_torchrl.envs.wind_turbine import rosco as adapter
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.envs.wind_turbine.rosco import RoscoController, nrel5mw, rosco_turbine, steps_of
from rt_torchrl.evaluation.real_episodes import RealEpisodes
from rt_torchrl.systems.real_system import episode_seed

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
