"""Costs as arguments against figures by hand, and terminal costs wherever J_a is computed."""

import math

import pytest
import torch
from seeds_and_numbers import double, seeded
from tensordict.nn import TensorDictModule

from rt_torchrl import PlantEnv, Rollout, Trajectory, control_cost
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank, PressureCost
from rt_torchrl.envs.flapping_wing.plant import TrackingCost
from rt_torchrl.envs.wind_turbine.plant import EngineeringCost, PaperCost, WindTurbine
from rt_torchrl.envs.wind_turbine.unknown import unknown
from rt_torchrl.systems.collectors import collector_of
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy

TIME_ZERO = torch.zeros((), dtype=torch.float64)
RATED = 122.9096


def turbine_cost(speed, torque, pitch, last, **weights):
    """The engineering cost at a generator speed [rad/s], an action and the action before it; other weights are zero."""
    zero = dict.fromkeys(("underspeed", "pitch_rate", "torque_rate"), 0.0)
    plant = WindTurbine(cost=EngineeringCost(**zero | weights))
    state = double(speed / 97.0, speed, 11.0, 0.0, *last)
    return plant.running_cost(TIME_ZERO, state, double(torque, pitch), double(11.0)).item()


def test_the_engineering_cost_term_by_term():
    full = 43_093.55
    still = (full, 5.0)
    assert turbine_cost(RATED, full, 5.0, still) == pytest.approx(0.0, abs=1e-12)
    assert turbine_cost(RATED, 0.25 * full, 5.0, still) == pytest.approx(0.75, rel=1e-12)
    assert turbine_cost(RATED, 0.25 * full, 5.0, still, power_demand=0.5) == pytest.approx(0.5, rel=1e-12)
    # Power above rated earns nothing, and costs the square of its share; a speed error is in units of 20 rad/s.
    excess, over = 0.1**2, (0.1 * RATED / 20.0) ** 2
    assert turbine_cost(1.1 * RATED, full, 5.0, still) == pytest.approx(excess + over, rel=1e-9)
    beyond = ((0.1 * RATED + 2.0) / 20.0) ** 2 + 10.0 * 0.1**2
    assert turbine_cost(1.1 * RATED + 2.0, 0.0, 5.0, still) == pytest.approx(1.0 + beyond, rel=1e-9)
    # A slow rotor costs where the wind is above rated, which it hardly is with 11 of 11.4 m/s.
    windy, slow = 1.0 / (1.0 + math.exp(0.8)), turbine_cost(RATED - 10.0, full, 5.0, still)
    assert turbine_cost(RATED - 10.0, full, 5.0, still, underspeed=4.0) - slow == pytest.approx(windy, rel=1e-9)
    # 1 deg and 15 kN m within 0.5 s.
    assert turbine_cost(RATED, full, 6.0, still, pitch_rate=1.0) == pytest.approx(4.0, rel=1e-12)
    less = turbine_cost(RATED, full - 15e3, 5.0, still)
    assert turbine_cost(RATED, full - 15e3, 5.0, still, torque_rate=1.0) - less == pytest.approx(4.0, rel=1e-12)


@pytest.mark.parametrize("name", ["pitch", "pitch_rate_1", "pitch_play", "pitch_sticks"])
def test_what_the_rates_of_the_actions_cost_is_that_of_what_a_drive_is_asked_for(name):
    """A pitch that rises by 0.25 deg in each interval costs 0.25 (deg/s)², wherever the blades are."""
    rated, free = (
        unknown(WindTurbine(horizon=5.0, cost=EngineeringCost(pitch_rate=weight)), (name,)) for weight in (1.0, 0.0)
    )
    state, wind = rated.draw_initial_state(1, seeded()), rated.draw_exogenous(1, seeded())
    pitch = 0.25 * torch.arange(1, 11, dtype=torch.float64)
    flown = Rollout(rated, rated.closure)(state, wind, torch.stack([torch.full_like(pitch, 3e4), pitch], -1)[None])
    charged = control_cost(rated, flown) - control_cost(free, flown)
    assert charged.item() == pytest.approx(0.25, rel=1e-9)


@pytest.mark.parametrize("kind", [PaperCost, EngineeringCost, TrackingCost, PressureCost])
def test_negative_weights_are_refused(kind):
    for name, value in vars(kind()).items():
        for wrong in (-1.0, math.nan) if isinstance(value, float) else ():
            with pytest.raises(ValueError, match=name):
                kind(**{name: wrong})


# The duty cycle


def test_an_open_or_shut_valve_is_the_same_for_both_commands():
    drop, duty = (CryogenicTank(horizon=3000.0, command=command) for command in ("drop", "duty"))
    state, load = drop.draw_initial_state(2, seeded()), drop.draw_exogenous(2, seeded())
    for share in (0.0, 1.0):
        ends = []
        for plant in (drop, duty):
            command = torch.full((2, plant.n_steps, 1), share * plant.actions[0].high, dtype=torch.float64)
            flown = Rollout(plant, plant.closure)(state, load, command)
            ends.append((flown.states, control_cost(plant, flown), plant.merit(flown.states, flown.actions, load)))
        torch.testing.assert_close(*ends, rtol=1e-12, atol=1e-12)


def test_a_duty_cycle_takes_more_heat_per_mass_than_a_half_open_valve():
    plant = CryogenicTank(command="duty")
    state = plant.state_at(double(500e3))
    half = plant.vent(state, double([0.5]), plant.closure)
    whole = plant.vent(state, double([1.0]), plant.closure)
    assert half.flow.item() == pytest.approx(0.5 * whole.flow.item(), rel=1e-12)
    assert half.heat.item() == pytest.approx(0.5 * whole.heat.item(), rel=1e-12)
    throttled = CryogenicTank().vent(state, double([50e3]), plant.closure)  # half the flow, which is a root of the drop
    assert throttled.flow.item() == pytest.approx(half.flow.item(), rel=1e-3)
    assert throttled.heat.item() < 0.97 * half.heat.item()


# Terminal costs


@pytest.fixture
def tank():
    return CryogenicTank(horizon=900.0, cost=PressureCost(end=7200.0))


def test_the_terminal_cost_is_a_part_of_every_cost(tank):
    plain = CryogenicTank(horizon=900.0)
    state, load = tank.draw_initial_state(3, seeded()), tank.draw_exogenous(3, seeded())
    policy = tank.make_policy(seeded(1))
    rollout = Rollout(tank, tank.closure, policy)
    flown = rollout(state, load)
    e = (flown.states[:, -1, 2] - 500e3) / 10e3
    expected = control_cost(plain, flown) + 7200.0 * e**2 / 900.0
    torch.testing.assert_close(control_cost(tank, flown), expected, rtol=1e-12, atol=0.0)
    for engine in ("native", "parallel", "autograd"):
        costs = Rollout(tank, tank.closure, policy, engine=engine).costs(state, load)
        torch.testing.assert_close(costs, expected, rtol=1e-11, atol=0.0)


def test_rewards_sum_to_the_cost_by_steps_and_by_machine_code(tank):
    policy = tank.make_policy(seeded(1))
    actor = LivePolicy(tank, policy, ExplorationConfig(), generator=seeded(5))
    with torch.no_grad():
        by_steps = TensorDictModule(policy, in_keys=["observation"], out_keys=["action"])
        stepped = PlantEnv(tank, seed=3).rollout(tank.n_steps, by_steps)
    for episode in (stepped, collector_of(PlantEnv(tank, seed=3), actor, tank).rollout()):
        states, rewards = torch.cat([episode["state"], episode["next", "state"][:, -1:]], 1), episode["next", "reward"]
        cost = control_cost(tank, Trajectory(states, episode["next", "applied"], episode["exogenous"]))
        torch.testing.assert_close(-rewards[..., 0].mean(-1), cost, rtol=1e-9, atol=0.0)
        e = (states[0, -1, 2] - 500e3) / 10e3
        expected = 7200.0 / 30.0 * e.item() ** 2
        assert (rewards[0, -2] - rewards[0, -1]).item() == pytest.approx(expected, rel=1e-2)
