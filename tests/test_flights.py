"""Setpoints of the plants, and the figure of one episode under several controllers."""

import matplotlib.colors
import pytest
import torch

from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.envs.wind_turbine.unknown import unknown
from rt_torchrl.figures import flights
from rt_torchrl.figures.style import ROLES
from rt_torchrl.trajectories.rollout import Rollout


def flown(plant, count=1, n=40):
    generator = torch.Generator().manual_seed(3)
    policy = plant.make_policy(generator)
    start = plant.draw_initial_state(count, generator)
    with torch.no_grad():
        return Rollout(plant, plant.closure, policy)(start, plant.draw_exogenous(count, generator)[:, :n])


def held(plant, one):
    return plant.setpoints(one.states[:, :-1], one.actions, one.exogenous)


def test_the_turbine_follows_what_its_cost_follows():
    plant = WindTurbine(horizon=20.0)
    one = flown(plant, 3)
    found = held(plant, one)
    speed, wanted = found["generator speed [rad/s]"]
    torch.testing.assert_close(speed, 97.0 * one.states[:, :-1, 0])
    # Of the reference speeds, the greatest is the rated one: 1173.7 rpm.
    assert wanted.max() <= 122.91 + 0.01 and (wanted <= 122.91 + 0.01).all()
    power, reference = found["power [MW]"]
    assert reference.max() <= 5.3 and power.shape == reference.shape == (3, 40)


def test_the_tank_holds_500_kPa_and_the_drone_its_target():
    tank = CryogenicTank(horizon=3000.0)
    pressure, wanted = held(tank, flown(tank))["pressure [kPa]"]
    assert (wanted == 500.0).all()
    torch.testing.assert_close(pressure, 1e-3 * flown(tank).states[:, :-1, 2])
    drone = FlappingWing(horizon=0.05, target=(2.0, 3.0))
    found = held(drone, flown(drone))
    assert [found[name][1].unique().item() for name in ("x [m]", "z [m]")] == [2.0, 3.0]
    assert held(Pendulum(), flown(Pendulum())) == {}


def test_an_extended_plant_has_the_setpoints_of_its_base():
    base = WindTurbine(horizon=20.0)
    real = unknown(base, ("pitch",))
    found = held(real, flown(real))
    assert list(found) == list(held(base, flown(base)))


def test_every_controller_is_drawn_and_the_setpoint_once():
    plant = WindTurbine(horizon=20.0)
    one = flown(plant)
    other = JonkmanController(plant).fly(one.states[:, 0], one.exogenous)
    figure = flights(plant, {"model_based": one.each()[0], "Jonkman": other.each()[0]})
    assert len(figure.axes) == 2 + len(plant.actions)
    labels = [line.get_label() for line in figure.axes[0].lines]
    assert labels == ["model-based", "setpoint", "Jonkman"]
    speed = figure.axes[0].lines[2]
    assert speed.get_ydata() == pytest.approx(97.0 * other.states[0, :-1, 0].numpy())
    assert matplotlib.colors.same_color(figure.axes[0].lines[0].get_color(), ROLES["model_based"])
    assert figure.axes[2].lines[0].get_ydata() == pytest.approx(one.actions[0, :, 0].numpy())


def test_a_plant_without_setpoints_shows_its_states():
    plant = Pendulum(horizon=1.0)
    one = flown(plant, n=plant.n_steps).each()[0]
    figure = flights(plant, {"model_free": one})
    assert len(figure.axes) == len(plant.states) + len(plant.actions)
    assert figure.axes[0].lines[0].get_ydata() == pytest.approx(one.states[:-1, 0].numpy())
