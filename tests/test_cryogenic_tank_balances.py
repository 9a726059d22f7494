"""The cryogenic tank over hours and days: mass and energy, runs with known ends, and its wall."""

import math

import pytest
import torch
from cryogenic_tank_reference import (
    A_S,
    K_JT,
    LIGHT_WALL,
    M_C,
    TIME_ZERO,
    U_HX,
    U_S,
    Ledger,
    PerRow,
    flown,
)
from seeds_and_numbers import double, seeded

from rt_torchrl.envs.cryogenic_tank.closures import ConstantCoefficients
from rt_torchrl.envs.cryogenic_tank.disturbances import CyclicLoad
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.trajectories.rollout import Rollout


@pytest.fixture(scope="module")
def plant():
    return CryogenicTank()


@pytest.fixture(scope="module")
def shut_and_open():
    """A shut tank at 500 kPa and one at 540 kPa with the valve wide open, under mean loads, over 120 h."""
    plant = CryogenicTank(dt=240.0)  # nothing changes fast under a constant load
    return plant, flown(plant, (500e3, 540e3), (0.0, 200e3), (129.0, 128.5), 1800)


# Conserved quantities


def assert_balances(ledger, first, last):
    vented, enthalpy, heat = last[..., 3:].unbind(-1)
    mass = ledger.mass(first)
    torch.testing.assert_close(ledger.mass(last) + vented, mass, rtol=1e-8, atol=0)
    # Relative to the energy that went through the tank, the heat of the load.
    gap = ledger.energy(last) - ledger.energy(first) - (heat - enthalpy)
    assert (gap.abs() < 1e-8 * heat).all()


@pytest.mark.parametrize("n", [480, pytest.param(14_400, marks=pytest.mark.nightly)])
@torch.no_grad()
def test_mass_and_energy_are_conserved(plant, n):
    ledger, policy = Ledger(plant), plant.make_policy(seeded(2))
    state = torch.cat([plant.draw_initial_state(3, seeded(1)), torch.zeros(3, 3, dtype=torch.float64)], -1)
    first, load = state, plant.draw_exogenous(3, seeded(1))
    for k in range(n):
        state = ledger.step(state, policy(plant.observe(TIME_ZERO, state[:, :3], load[:, k])), load[:, k])
    assert state[:, 3].min() > 0.1
    assert_balances(ledger, first, state)


def test_vented_mass_is_what_the_tank_lost(shut_and_open):
    plant, states = shut_and_open
    actions = double(0.0, 200e3).view(2, 1, 1).expand(2, 1800, 1)
    vented = plant.vented_mass(states, actions, plant.closure)
    mass = Ledger(plant).mass(states)
    assert vented[0].abs().max() == 0
    # Here at steps of 240 s, in which the wall's first minutes leave 1e-7.
    torch.testing.assert_close(mass[:, :1] - mass, vented, rtol=0, atol=1e-6 * mass[0, 0].item())


# Long runs: figures of a separate calculation


def test_pressure_of_a_shut_tank(shut_and_open):
    _, states = shut_and_open
    assert 1e-3 * states[0, -1, 2].item() == pytest.approx(628.0, abs=3.0)


def test_vent_wide_open_brings_an_over_pressure_down(shut_and_open):
    plant, states = shut_and_open
    k = int((states[1, :, 2] < 500e3).int().argmax())
    actions = torch.full((1800, 1), 200e3, dtype=torch.float64)
    assert k * plant.dt / 3600 == pytest.approx(38.0, abs=1.5)
    assert plant.vented_mass(states[1], actions, plant.closure)[k].item() == pytest.approx(85.0, abs=2.0)


def test_any_reachable_pressure_is_in_the_table(shut_and_open):
    plant, states = shut_and_open
    # A start four standard deviations, 100 kPa, from the set point shifts a run by as much.
    assert states[0, :, 2].max() + 100e3 < plant.greatest_pressure
    assert states[1, :, 2].min() - 140e3 > plant.back_pressure


def test_sensitivity_to_the_coefficients():
    """RMS over 24 h of what 10 % more of each does to p, with the valve half open, against estimates by hand."""
    plant, truth, n, drop = CryogenicTank(dt=120.0), double(U_S, U_HX, K_JT), 720, 100e3
    rows = truth * (1.0 + 0.1 * torch.cat([torch.zeros(1, 3), torch.eye(3)]).double())
    load = CyclicLoad().draw(1, n, plant.dt, seeded(5)).unsqueeze(-1).expand(4, -1, -1)
    p = flown(plant, (500e3,) * 4, (drop,) * 4, load, n, PerRow(rows))[..., 2]
    rms = (p[1:] - p[0]).pow(2).mean(-1).sqrt()

    state, action = plant.state_at(double(*p[0, :1])).expand(4, 3), torch.full((4, 1), drop, dtype=torch.float64)
    held = plant.held_load(state, action, PerRow(rows))
    warmer = state[:2] + double(0.0, 1.0).view(2, 1) * double(1.0 / (U_S * A_S), 0.0, 0.0)
    p_dot = plant.vector_field(TIME_ZERO, warmer, action[:2], torch.zeros(2, 1, dtype=torch.float64), plant.closure)[
        :, 2
    ]
    per_joule = (p_dot[1] - p_dot[0]).item()  # [Pa/J], nearly constant
    cooling = per_joule * (held[2:] - held[0]).abs() * n * plant.dt / math.sqrt(3.0)  # RMS of a ramp
    # A better wall gives back the heat that its superheat held.
    wall = per_joule * M_C * load[0].pow(2).mean().sqrt().item() / (U_S * A_S) * (0.1 / 1.1)
    # What the fluid's own warming and the cycle of the load change is a few per cent.
    torch.testing.assert_close(rms, torch.cat([double(wall), cooling]), rtol=0.1, atol=0)
    assert rms[0].item() == pytest.approx(4.0, abs=0.5)
    assert 4 * rms[0] < rms[1] < rms[2]  # U_s is the hardest to see, K_JT the easiest


@torch.no_grad()
def test_vented_mass_weighs_a_tenth_of_the_tracking_error_at_the_start():
    plant = CryogenicTank(dt=240.0)
    n, rows = 1800, 40
    state, generator = plant.draw_initial_state(rows, seeded(6)), seeded(8)
    policies = [plant.make_policy(generator) for _ in range(rows)]
    law, scaled = policies[0], torch.stack([policy.scaled for policy in policies])
    load = torch.full((rows, 1), plant.load.mean, dtype=torch.float64)
    tracking, vented = 0.0, 0.0
    for _ in range(n):
        e = plant.observe(TIME_ZERO, state, load)[:, 0]
        share = e / law.reference_error
        drop = law.clip((scaled[:, 0] * share + scaled[:, 1] * share**3 + scaled[:, 2]).unsqueeze(-1))
        tracking += e.pow(2).mean().item() / n
        vented += plant.vent(state, drop, plant.closure).flow.mean().item() / n
        state = plant.step(TIME_ZERO, state, drop, load, plant.closure).state
    # A factor of two, because policies with the wrong sign dominate the tracking error.
    assert 0.05 < plant.cost.vented * vented / tracking < 0.2


# The wall


def test_an_unstable_wall_is_refused_with_the_figures():
    with pytest.raises(ValueError, match=r"0\.1852.*dt·rate = 5\.56.*2\.785.*dt <= 15 s.*wall='exponential'"):
        CryogenicTank(wall_heat_capacity=LIGHT_WALL)


def test_stability_is_checked_with_the_closure_of_the_plant(plant):
    assert plant.wall_rate(plant.closure) == pytest.approx(U_S * A_S / M_C, rel=1e-12)
    assert plant.wall_rate(plant.make_closure(seeded())) == pytest.approx(A_S / M_C, rel=1e-12)
    with pytest.raises(ValueError, match="unstable"):
        CryogenicTank(closure=ConstantCoefficients(double(630.0, 75.0, K_JT)))
    CryogenicTank(closure=ConstantCoefficients(double(620.0, 75.0, K_JT)))


@torch.no_grad()
def test_exponential_wall_conserves_energy():
    plant = CryogenicTank(wall="exponential", wall_heat_capacity=LIGHT_WALL)
    load = plant.draw_exogenous(1, seeded(4))[:, :200]
    states = flown(plant, (500e3,), (0.0,), load, 200)
    energy = Ledger(plant).energy(states, LIGHT_WALL)
    gained = (plant.dt * load[..., 0]).cumsum(-1)
    torch.testing.assert_close(energy[:, 1:] - energy[:, :1], gained, rtol=0, atol=1e-8 * gained[0, -1].item())


@pytest.mark.parametrize("heat_capacity, fine", [(M_C, 30.0), (LIGHT_WALL, 5.0)])
def test_exponential_wall_agrees_with_a_resolved_one(heat_capacity, fine):
    n, inner = 60, round(30.0 / fine)
    exact = CryogenicTank(dt=fine, horizon=fine, wall_heat_capacity=heat_capacity)
    plant = CryogenicTank(wall="exponential", wall_heat_capacity=heat_capacity)
    load = plant.draw_exogenous(1, seeded(4))[:, :n]
    coarse = flown(plant, (500e3,), (100e3,), load, n)
    resolved = flown(exact, (500e3,), (100e3,), load.repeat_interleave(inner, 1), n * inner)[:, ::inner]
    gap = (coarse - resolved).abs()[0].amax(0)
    # T_s lags by what T moves in an interval, 1e-4 K; while the wall warms up, the heat of a part of an interval.
    assert gap[0] < 2e-4 and gap[2] < 5.0
    assert resolved[0, :, 2].max() - resolved[0, :, 2].min() > 300.0


def test_exponential_wall_survives_any_closure():
    plant = CryogenicTank(wall="exponential", wall_heat_capacity=1.0)
    closure = ConstantCoefficients(double(1e5, 75.0, K_JT))
    rollout = Rollout(plant, closure)
    states = rollout(
        plant.draw_initial_state(2, seeded()),
        plant.draw_exogenous(2, seeded())[:, :50],
        torch.full((2, 50, 1), 1e5, dtype=torch.float64),
    ).states
    T = plant.saturation(states[..., 2]).T
    assert (states[:, 1:, 0] - T[:, 1:]).abs().max() < 1e-3
