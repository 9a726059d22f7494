"""Real systems that their twin does not know: their names, their parts, and how recipes take them."""

import math

import pytest
import torch
from seeds_and_numbers import drawn, seeded
from test_export_recipe import RECIPES, leave_run

from rt_torchrl import Rollout, check_plant, load_run
from rt_torchrl.envs.cryogenic_tank import unknown as tanks
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing import unknown as drones
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine import unknown as turbines
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.envs.wind_turbine.unknown import LaggedInflow, MisreadWind
from rt_torchrl.runs.loaded_run import config_class_of

KNOWN = {
    "wind_turbine": (turbines, lambda: WindTurbine(horizon=20.0, observe=("scheduled",))),
    "flapping_wing": (drones, lambda: FlappingWing(horizon=0.1, target=(1.0, 1.0))),
    "cryogenic_tank": (tanks, lambda: CryogenicTank(horizon=3000.0, command="duty")),
}


def flown(plant, state, exogenous, command):
    return Rollout(plant, plant.closure)(state, exogenous, command).states


def systems_of(plant):
    """All names, of which those that hold no part that an earlier one has not are slow."""
    seen, systems = set(), KNOWN[plant][0].SYSTEMS
    for name, parts in systems.items():
        yield pytest.param(plant, name, marks=pytest.mark.slow if seen.issuperset(parts) else ())
        seen.update(parts)


@pytest.mark.parametrize(("plant", "name"), [system for plant in KNOWN for system in systems_of(plant)])
def test_every_system_fulfils_the_contract_and_reads_what_its_twin_knows(plant, name):
    systems, make = KNOWN[plant]
    base = make()
    system = systems.unknown(base, (name,))
    check_plant(system, steps=5, traced=False, trained=False)
    assert system.readings == base.states and system.name == plant
    assert set(systems.SYSTEMS[name]) <= set(systems.PARTS)


def test_the_power_of_a_rotor_that_keeps_its_speed_follows_exponentially():
    base = WindTurbine(inertia=1e15, observe=("scheduled",))
    plant = LaggedInflow(base, 10.0)
    check_plant(LaggedInflow(WindTurbine(horizon=20.0), 10.0), steps=5, traced=False, trained=False)
    read, n, wind = base.draw_initial_state(1, seeded()), 60, 13.0
    state, exogenous = plant.at_rest(read), torch.full((1, n, 1), wind, dtype=torch.float64)
    power = 1e6 * flown(plant, state, exogenous, read[:, None, 4:6].expand(1, n, 2))[0, :, -1]
    steady = read[:, 0] * base.aerodynamic_torque(read[:, 0], read[:, 5], torch.tensor([wind]).double(), base.closure)
    t = base.dt * torch.arange(n + 1, dtype=torch.float64)
    torch.testing.assert_close(power, steady + (power[0] - steady) * torch.exp(-t / 10.0), rtol=1e-6, atol=0.0)
    # C_p is 0.4 at the start, in the filtered wind.
    assert power[0].item() == pytest.approx(0.2 * 1.225 * math.pi * 63.0**2 * read[0, 2].item() ** 3, rel=1e-9)


def test_a_rotor_turns_in_the_wind_and_its_filter_in_what_the_anemometer_reads():
    base = WindTurbine()
    plant = MisreadWind(base, 0.9)
    (state, read), (true, wind) = drawn(plant, 2, 2), drawn(base, 2, 2)
    read, wind = read[:, :40], wind[:, :40]
    torch.testing.assert_close(read, 0.9 * wind)
    command = true[:, None, 4:6].expand(2, 40, 2)
    found, expected = flown(plant, state, read, command), flown(base, true, wind, command)
    torch.testing.assert_close(found[..., :2], expected[..., :2], rtol=1e-12, atol=0.0)
    torch.testing.assert_close(found[..., 2], 0.9 * expected[..., 2], rtol=1e-12, atol=0.0)


def test_several_systems_combine_in_the_order_of_their_parts():
    config = config_class_of(RECIPES / "wind_turbine.py")(unknown=("pitch", "inflow"), policy="scheduled")
    hidden = [state.name for state in config.plant().states if state not in config.plant().readings]
    assert hidden[0] == "lagged_torque" and hidden[1] == "resonant_blade_pitch"
    assert config.believed().states == config.plant().readings


def test_the_policies_of_an_unknown_system_are_made_for_what_the_twin_knows(tmp_path):
    config, parts = leave_run(tmp_path, "wind_turbine", policy="scheduled", unknown=("pitch",))
    run = load_run(tmp_path)
    assert run.physics.states == run.plant.readings and run.plant.unread == 4
    assert type(run.closure) is type(config.believed().make_closure(torch.Generator()))
    assert torch.equal(run.policy("model_based").weights, parts["model_based"].weights)
