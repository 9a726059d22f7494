"""The cryogenic tank against a separate reading with CoolProp, and figures of a separate calculation."""

import math

import CoolProp.CoolProp as CP
import numpy as np
import pytest
import torch
from cryogenic_tank_reference import (
    A_HX,
    A_S,
    K_JT,
    TIME_ZERO,
    U_HX,
    U_S,
    coolprop_rates,
)
from seeds_and_numbers import double, seeded
from torch import nn

from rt_torchrl.envs.cryogenic_tank.closures import ConstantCoefficients, CubicVentLaw
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.plants.policies import mlp
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout


@pytest.fixture(scope="module")
def plant():
    return CryogenicTank()


# The vent: figures of a separate calculation at p = 500 kPa


@pytest.mark.parametrize(
    "drop, flow, heat, held",
    [(25e3, 0.224, 66, 75), (50e3, 0.316, 106, 119), (100e3, 0.447, 162, 180), (200e3, 0.632, 236, 262)],
)
def test_vent_at_the_set_point(plant, drop, flow, heat, held):
    state, action = plant.state_at(double(500e3)), double(drop).unsqueeze(-1)
    vent = plant.vent(state, action, plant.closure)
    assert 1e3 * vent.flow.item() == pytest.approx(flow, abs=6e-4)  # half a unit of the last digit
    assert vent.heat.item() == pytest.approx(heat, abs=0.6)
    assert plant.held_load(state, action, plant.closure).item() == pytest.approx(held, abs=0.6)


def test_held_load_holds_the_pressure(plant):
    drop = torch.linspace(0.0, 200e3, 9, dtype=torch.float64).unsqueeze(-1)
    state = plant.state_at(torch.linspace(400e3, 700e3, 9, dtype=torch.float64))
    load = plant.held_load(state, drop, plant.closure)
    state[:, 0] += load / (U_S * A_S)
    rates = plant.vector_field(TIME_ZERO, state, drop, load.unsqueeze(-1), plant.closure)
    # Against 1e-3 Pa/s per watt.
    assert rates[:, 2].abs().max() < 1e-9 and rates[:, 0].abs().max() < 1e-15


def test_exchanger_meets_the_papers_energy_balance(plant):
    drop = double(30e3, 120e3).unsqueeze(-1)
    state = plant.state_at(double(500e3, 620e3))
    vent = plant.vent(state, drop, plant.closure)
    tank, line = plant.saturation(state[:, 2]), plant.saturation(state[:, 2] - drop[:, 0])
    cooling = vent.flow * (line.h_v - tank.h_l)  # ṁ_c Δh_c, which the pump's liquid gives up with ε = 1
    torch.testing.assert_close(vent.effectiveness * cooling, vent.heat, rtol=1e-12, atol=0)
    ntu = U_HX * A_HX * (tank.T - line.T) / cooling
    torch.testing.assert_close(vent.effectiveness, 1.0 - torch.exp(-ntu), rtol=1e-12, atol=0)


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


def test_gradients_of_the_vector_field(plant):
    state = plant.state_at(double(350e3, 500e3, 800e3))
    state[:, 0] += double(0.01, 0.05, 0.09)
    sizes = double(0.1, 1.0, 1e4)
    units = double(1e4, 1e5, 1.0)

    class Given(nn.Module):
        def __init__(self, weights):
            super().__init__()
            self.weights = weights

        def forward(self, features):
            return self.weights.exp().expand(*features.shape[:-1], 3)

    def field(shift, drop, load, weights):
        rates = plant.vector_field(TIME_ZERO, state + sizes * shift, 1e5 * drop, 1e2 * load, Given(weights))
        return units * rates

    drop, load = double(0.3, 1.0, 1.9).unsqueeze(-1), double(0.5, 1.3, 3.0).unsqueeze(-1)
    inputs = (torch.zeros(3, 3, dtype=torch.float64), drop, load, double(3.9, 4.3, 26.9))
    assert torch.autograd.gradcheck(field, tuple(x.requires_grad_() for x in inputs))


def test_a_pressure_beyond_the_table_is_a_divergence():
    plant = CryogenicTank()
    load = torch.full((1, 100, 1), 1e6, dtype=torch.float64)
    with pytest.raises(DivergenceError, match="cryogenic_tank.*diverged"):
        Rollout(plant, plant.closure)(plant.state_at(double(895e3)), load, torch.zeros(1, 100, 1, dtype=torch.float64))
    with pytest.raises(ValueError, match="p=950 kPa"):
        plant.state_at(double(950e3))


def test_draws_repeat_with_their_seed(plant):
    assert plant.n_steps == 14_400
    assert torch.equal(plant.draw_exogenous(2, seeded(7)), plant.draw_exogenous(2, seeded(7)))
    assert torch.equal(plant.draw_initial_state(2, seeded(7)), plant.draw_initial_state(2, seeded(7)))


def test_initial_states(plant):
    T_s, V_l, p = plant.draw_initial_state(4000, seeded()).unbind(-1)
    assert p.mean().item() == pytest.approx(500e3, abs=1.5e3) and p.std().item() == pytest.approx(25e3, rel=0.04)
    assert (V_l == 42.0).all()
    assert torch.equal(T_s, plant.saturation(p).T)


# Closure, policy, costs


def test_closure_starts_where_the_paper_does(plant):
    start = plant.make_closure(seeded()).named_coefficients()
    assert {name: value.item() for name, value in start.items()} == pytest.approx(
        {"U_s": 1.0, "U_HX": 1.0, "K_JT": 10e9}
    )
    assert not any(weight.requires_grad for weight in plant.parameters())


def test_any_positive_closure_of_the_features_can_stand_in():
    class Perceptron(nn.Module):
        def __init__(self):
            super().__init__()
            self.network = mlp(4, (8,), 3, generator=seeded())
            self.register_buffer("size", double(U_S, U_HX, K_JT))

        def forward(self, features):
            assert features.abs().max() < 5.0
            return self.size * torch.exp(0.1 * self.network(features))

    closure = Perceptron()
    for wall in ("explicit", "exponential"):
        plant = CryogenicTank(closure=closure, wall=wall)
        state = plant.state_at(torch.full((3, 7), 500e3).double())
        load, drop = torch.full((3, 1, 1), 129.0).double(), torch.full((3, 7, 1), 5e4).double()
        end = plant.step(torch.zeros(3, 1).double(), state, drop, load, closure).state
        assert end.shape == (3, 7, 3)
        assert torch.equal(end[:, 0], end[:, 6])
        gradients = torch.autograd.grad(end.sum(), list(closure.parameters()))
        assert all(gradient.isfinite().all() and gradient.abs().max() > 0 for gradient in gradients)


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


# Bad input


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"fluid": "Hydrogenium"}, "fluid='Hydrogenium'"),
        ({"fluid": "Helium"}, "critical pressure"),
        ({"wall": "thin"}, "wall"),
        ({"wall_heat_capacity": 0.0}, "wall_heat_capacity"),
        ({"wall_heat_capacity": math.nan}, "wall_heat_capacity"),
        ({"command": "flow"}, "command"),
        ({"observe": ("level",)}, "level"),
        ({"dt": 400.0, "horizon": 4e5}, "unstable"),
        ({"dt": 31.0}, "horizon"),
    ],
)
def test_bad_arguments_raise(arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):  # the type checker of the tests refuses "thin" first
        CryogenicTank(**arguments)


@pytest.mark.parametrize("coefficients", [(1.0, 2.0), (1.0, -1.0, 1.0), (1.0, 0.0, 1.0), (1.0, math.nan, 1.0)])
def test_bad_coefficients_raise(coefficients):
    with pytest.raises(ValueError, match="coefficients"):
        ConstantCoefficients(double(*coefficients))


def test_para_hydrogen():
    plant = CryogenicTank(fluid="ParaHydrogen")
    assert plant.state_at(double(500e3))[0, 0].item() == pytest.approx(27.112, abs=5e-4)
