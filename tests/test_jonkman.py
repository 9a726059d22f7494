"""Jonkman's controller on the turbine, against the figures known for it on this rotor."""

import pytest
import torch

from rt_torchrl.envs.wind_turbine.jonkman import JonkmanController
from rt_torchrl.envs.wind_turbine.plant import WindTurbine


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
        controller.c["VS_CtInSp"],
        controller.c["VS_Rgn2Sp"],
        controller.transition,
        controller.c["VS_RtGnSp"],
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
    assert plant.gear_ratio * flown.states[0, -1, 0].item() == pytest.approx(controller.c["PC_RefSpd"], rel=1e-3)
    power = plant.generator_power(flown.states[:, -2], flown.actions[:, -1]).item()
    assert power == pytest.approx(controller.c["VS_RtPwr"], rel=1e-3)
