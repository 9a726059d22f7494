"""A separate reading of the cryogenic tank with CoolProp, and its books of mass and energy."""

import math

import CoolProp.CoolProp as CP
import numpy as np
import torch
from seeds_and_numbers import double
from torch import nn

from rt_torchrl.plants.sampling import rk4_step

V_T, A_S, A_HX, M_C = 60.0, 74.1, 200 * math.pi * 0.005 * 2, 500e3
U_S, U_HX, K_JT = 50.0, 75.0, 500e9
LIGHT_WALL = 20e3  # [J/K]
TIME_ZERO = torch.zeros((), dtype=torch.float64)


class PerRow(nn.Module):
    """Constant coefficients that differ from one row of the batch to the next."""

    def __init__(self, rows):
        super().__init__()
        self.register_buffer("rows", rows)

    def forward(self, features):
        return self.rows.expand(*features.shape[:-1], 3)


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


@torch.no_grad()
def flown(plant, p, drop, load, n, closure=None):
    """States of ``n`` intervals from rest, one row per initial pressure, under held actions and loads."""
    state = plant.state_at(double(*p))
    action, load = (double(*x).unsqueeze(-1) if isinstance(x, tuple) else x for x in (drop, load))
    states = [state]
    for k in range(n):
        z = load if load.ndim == 2 else load[:, k]
        state = plant.step(TIME_ZERO, state, action, z, closure or plant.closure).state
        states.append(state)
    return torch.stack(states, 1)


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

    def energy(self, state, heat_capacity=M_C):
        """Energy H − pV of wall and mixture."""
        tank, V_l, p = self.plant.saturation(state[..., 2]), state[..., 1], state[..., 2]
        enthalpy = tank.rho_l * tank.h_l * V_l + tank.rho_v * tank.h_v * (V_T - V_l)
        return heat_capacity * state[..., 0] + enthalpy - p * V_T
