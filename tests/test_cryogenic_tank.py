"""The cryogenic tank against a separate reading with CoolProp, and its conserved quantities."""

import math

import CoolProp.CoolProp as CP
import numpy as np
import pytest
import torch
from saturation_tables import HIGH, LOW, table_of
from seeds_and_numbers import double, seeded

from rt_torchrl import DivergenceError, Rollout, rk4_step
from rt_torchrl.envs.cryogenic_tank.closures import CubicVentLaw
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.cryogenic_tank.saturation import DATA, FLUIDS, Saturation

# A separate reading of the cryogenic tank with CoolProp, and its books of mass and energy.


V_T, A_S, A_HX, M_C = 60.0, 74.1, 200 * math.pi * 0.005 * 2, 500e3
U_S, U_HX, K_JT = 50.0, 75.0, 500e9
TIME_ZERO = torch.zeros((), dtype=torch.float64)


def coolprop_rates(T_s, V_l, p, drop, load):
    """The paper's three equations with CoolProp's properties and derivatives, two of them solved as a matrix."""
    fluid = CP.AbstractState("HEOS", "Hydrogen")
    value, slope = {}, {}
    for phase, quality in (("l", 0), ("v", 1)):
        fluid.update(CP.PQ_INPUTS, p, quality)
        value |= {"T": fluid.T(), f"rho_{phase}": fluid.rhomass(), f"h_{phase}": fluid.hmass()}
        rho_p, h_p = (fluid.first_saturation_deriv(key, CP.iP) for key in (CP.iDmass, CP.iHmass))
        slope |= {f"rho_{phase}": rho_p, f"H_{phase}": rho_p * fluid.hmass() + fluid.rhomass() * h_p}
    T_1, h_2 = (CP.PropsSI(key, "P", p - drop, "Q", 1, "Hydrogen") for key in "TH")
    flow = math.sqrt(drop / K_JT)
    latent = h_2 - value["h_l"]
    heat = (1 - math.exp(-U_HX * A_HX * (value["T"] - T_1) / (flow * latent))) * flow * latent
    into_fluid = U_S * A_S * (T_s - value["T"])
    V_v = V_T - V_l
    H_l, H_v = (value[f"rho_{x}"] * value[f"h_{x}"] for x in "lv")
    matrix = [
        [value["rho_l"] - value["rho_v"], slope["rho_v"] * V_v + slope["rho_l"] * V_l],
        [H_l - H_v, slope["H_v"] * V_v + slope["H_l"] * V_l - V_T],
    ]
    V_dot, p_dot = np.linalg.solve(matrix, [-flow, into_fluid - flow * value["h_l"] - heat])
    return [(load - into_fluid) / M_C, V_dot, p_dot]


@pytest.fixture(scope="module")
def plant():
    return CryogenicTank()


# The vent


def test_held_load_holds_the_pressure(plant):
    drop = torch.linspace(0.0, 200e3, 9, dtype=torch.float64).unsqueeze(-1)
    state = plant.state_at(torch.linspace(400e3, 700e3, 9, dtype=torch.float64))
    load = plant.held_load(state, drop, plant.closure)
    state[:, 0] += load / (U_S * A_S)
    rates = plant.vector_field(TIME_ZERO, state, drop, load.unsqueeze(-1), plant.closure)
    # Against 1e-3 Pa/s per watt.
    assert rates[:, 2].abs().max() < 1e-9 and rates[:, 0].abs().max() < 1e-15


def test_a_shut_valve_takes_nothing_and_is_differentiable(plant):
    state = plant.state_at(double(500e3, 500e3)).requires_grad_()
    drop = double(0.0, 1e-3).unsqueeze(-1).requires_grad_()
    vent = plant.vent(state, drop, plant.closure)
    assert vent.flow[0] == 0 and vent.heat[0] == 0
    for part in vent:
        slopes = torch.autograd.grad(part.sum(), (state, drop), retain_graph=True)
        assert part.isfinite().all() and all(slope.isfinite().all() for slope in slopes)
    (slope,) = torch.autograd.grad(vent.heat.sum(), drop)
    # Below the laminar drop flow and heat are proportional to it, with the slope they have at zero.
    torch.testing.assert_close(slope[0], slope[1])
    torch.testing.assert_close(slope[1, 0], vent.heat[1] / 1e-3)


def test_heat_has_no_step_where_the_secant_takes_over(plant):
    drop = torch.linspace(0.5, 1.5, 1001, dtype=torch.float64).unsqueeze(-1)
    heat = plant.vent(plant.state_at(torch.full((1001,), 500e3).double()), drop, plant.closure).heat
    steps = heat.diff()
    assert ((steps - steps.mean()).abs() < 0.01 * steps.mean()).all()


def test_back_pressure_limits_the_drop(plant):
    state, drop = plant.state_at(double(150e3)), double(200e3).unsqueeze(-1)
    assert plant.valve_outlet(state[:, 2], drop[:, 0]).item() == 80e3
    assert plant.vent(state, drop, plant.closure).flow.item() == pytest.approx(math.sqrt(70e3 / K_JT), rel=1e-6)


# The vector field


def test_rates_are_those_of_coolprop(plant):
    rng = np.random.default_rng(3)
    for _ in range(20):
        p, V_l, drop = rng.uniform(300e3, 850e3), rng.uniform(5.0, 55.0), rng.uniform(18e3, 200e3)
        load, T_s = rng.uniform(10.0, 360.0), CP.PropsSI("T", "P", p, "Q", 0, "Hydrogen") + rng.uniform(0.0, 0.1)
        rates = plant.vector_field(TIME_ZERO, double(T_s, V_l, p), double(drop), double(load), plant.closure)
        # The laminar valve departs from the root by 8e-6 at 18 kPa, the fitted slopes by 2e-6 of their greatest.
        np.testing.assert_allclose(rates, coolprop_rates(T_s, V_l, p, drop, load), rtol=1e-4, atol=0)


def test_a_pressure_beyond_the_table_is_a_divergence(plant):
    load = torch.full((1, 100, 1), 1e6, dtype=torch.float64)
    with pytest.raises(DivergenceError, match="cryogenic_tank.*diverged"):
        Rollout(plant, plant.closure)(plant.state_at(double(895e3)), load, 0.0 * load)


# Closure, policy, costs


def test_policy_is_the_papers(plant):
    policy = plant.make_policy(seeded(3))
    assert isinstance(policy, CubicVentLaw) and sum(w.numel() for w in policy.parameters()) == 3
    e = torch.linspace(-15.0, 15.0, 31, dtype=torch.float64)
    w1, w2, w3 = policy.weights
    expected = 0.5 * 200e3 * (torch.tanh(w1 * e + w2 * e**3 + w3) + 1.0)
    torch.testing.assert_close(policy(e.unsqueeze(-1)).squeeze(-1), expected)


def test_costs(plant):
    state, t = double(27.0, 42.0, 520e3), TIME_ZERO
    assert plant.observe(t, state, double(100.0)).item() == pytest.approx(2.0, rel=1e-12)
    cost = plant.running_cost(t, state, double(50e3), double(100.0)).item()
    assert cost == pytest.approx(4.0 + 5000.0 * math.sqrt(50e3 / K_JT), rel=1e-6)
    gap = plant.discrepancy(state, state + double(0.05, -0.1, 3e3)).item()
    assert gap == pytest.approx((1.0 + 4.0 + 9.0) / 4.32e5, rel=1e-9)


# Conserved quantities


class Ledger:
    """The plant with three more states, integrated by the same step: what has left by the vent, and the heat let in.

    So the integrals of the fluxes have the order of the states. The fluxes are read off the vent and the saturation
    table; the rates that they are compared with come from the derivatives of the balances.
    """

    def __init__(self, plant):
        self.plant = plant

    def field(self, t, state, action, load):
        rates = self.plant.vector_field(t, state[..., :3], action, load, self.plant.closure)
        vent = self.plant.vent(state[..., :3], action, self.plant.closure)
        enthalpy = vent.flow * self.plant.saturation(state[..., 2]).h_l + vent.heat
        return torch.cat([rates, torch.stack([vent.flow, enthalpy, load[..., 0]], -1)], -1)

    def step(self, state, action, load):
        return rk4_step(lambda t, s: self.field(t, s, action, load), TIME_ZERO, state, self.plant.dt)

    def mass(self, state):
        tank, V_l = self.plant.saturation(state[..., 2]), state[..., 1]
        return tank.rho_l * V_l + tank.rho_v * (V_T - V_l)

    def energy(self, state):
        """Energy H − pV of wall and mixture."""
        tank, V_l, p = self.plant.saturation(state[..., 2]), state[..., 1], state[..., 2]
        enthalpy = tank.rho_l * tank.h_l * V_l + tank.rho_v * tank.h_v * (V_T - V_l)
        return M_C * state[..., 0] + enthalpy - p * V_T


@pytest.mark.parametrize("n", [480, pytest.param(14_400, marks=pytest.mark.nightly)])
@torch.no_grad()
def test_mass_and_energy_are_conserved(plant, n):
    ledger, policy = Ledger(plant), plant.make_policy(seeded(2))
    state = torch.cat([plant.draw_initial_state(3, seeded(1)), torch.zeros(3, 3, dtype=torch.float64)], -1)
    first, load = state, plant.draw_exogenous(3, seeded(1))
    for k in range(n):
        state = ledger.step(state, policy(plant.observe(TIME_ZERO, state[:, :3], load[:, k])), load[:, k])
    assert state[:, 3].min() > 0.1
    vented, enthalpy, heat = state[:, 3:].unbind(-1)
    torch.testing.assert_close(ledger.mass(state) + vented, ledger.mass(first), rtol=1e-8, atol=0)
    # Relative to the energy that went through the tank, the heat of the load.
    gap = ledger.energy(state) - ledger.energy(first) - (heat - enthalpy)
    assert (gap.abs() < 1e-8 * heat).all()


# Saturation properties against CoolProp.


KEYS = (("T", 0), ("D", 0), ("D", 1), ("H", 0), ("H", 1))


def slopes_of_coolprop(fluid, p):
    """First derivatives of T, ρ and h along the saturation line by CoolProp itself."""
    state, columns = CP.AbstractState("HEOS", fluid), []
    for key, quality in ((CP.iT, 0), (CP.iDmass, 0), (CP.iDmass, 1), (CP.iHmass, 0), (CP.iHmass, 1)):
        column = []
        for each in p:
            state.update(CP.PQ_INPUTS, each, quality)
            column.append(state.first_saturation_deriv(key, CP.iP))
        columns.append(column)
    return np.array(columns)


# Properties


@pytest.mark.parametrize("fluid", FLUIDS)
def test_values_and_slopes_are_those_of_coolprop(fluid):
    p = np.linspace(LOW, HIGH, 301)  # no nodes of the fit, except for the two ends
    values, slopes = (
        np.stack([x.numpy() for x in part]) for part in Saturation(fluid).with_slopes(torch.from_numpy(p))
    )
    truth = np.array([CP.PropsSI(key, "P", p, "Q", quality, fluid) for key, quality in KEYS])
    assert (np.abs(values - truth).max(1) < 1e-6 * np.abs(truth).max(1)).all()
    truth, slopes = slopes_of_coolprop(fluid, p[1:-1]), slopes[:, 1:-1]
    assert (np.abs(slopes - truth).max(1) < 1e-4 * np.abs(truth).max(1)).all()


def test_the_tables_are_those_that_coolprop_makes():
    assert {file.stem for file in DATA.iterdir()} == {*FLUIDS}
    np.testing.assert_allclose(np.loadtxt(DATA / "Hydrogen.csv", delimiter=","), table_of("Hydrogen"), rtol=1e-9)


# Outside the range


@pytest.mark.parametrize("p", [79.9e3, 900.1e3, 0.0, -1.0, 1e9, math.inf, math.nan])
def test_outside_the_range_everything_is_nan_and_check_raises(p):
    fit = Saturation()
    values, slopes = fit.with_slopes(double(p, 500e3))
    assert all(x[0].isnan() and x[1].isfinite() for x in (*values, *slopes))
    with pytest.raises(ValueError, match="Hydrogen, 80 … 900 kPa"):
        fit.check(double(p, 500e3))
    fit.check(double(LOW, HIGH))


def test_derivatives_of_values_and_slopes():
    fit = Saturation()
    sizes = torch.stack(fit(double(HIGH)), -1).abs()

    def scaled(log_p):
        values, slopes = fit.with_slopes(log_p.exp())
        return torch.stack(values, -1) / sizes, torch.stack(slopes, -1) / sizes * HIGH

    log_p = torch.linspace(math.log(LOW) + 0.01, math.log(HIGH) - 0.01, 7, dtype=torch.float64)
    assert torch.autograd.gradcheck(scaled, log_p.requires_grad_())
