r"""Balances of the saturated mixture in the tank (paper, section 5.3)."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from rt_torchrl.envs.cryogenic_tank.saturation import Properties
from rt_torchrl.envs.cryogenic_tank.vent import Vent


class Conditions(NamedTuple):
    """The quantities in one state from which the rates follow."""

    tank: Properties
    slope: Properties  # slopes of the tank's properties, per Pa
    wall_conductance: Tensor  # U_s A_s [W/K]
    vent: Vent


def mixture_rates(
    V_l: Float[Tensor, "*batch"],
    volume: float,
    tank: Properties,
    slope: Properties,
    flow: Float[Tensor, "*batch"],
    heating: Float[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    r"""V̇_l [m³/s] and ṗ [Pa/s] from the balances of mass and enthalpy, two linear equations with H = ρh:

    .. math::
        (\rho_l - \rho_v)\dot V_l + M_p\,\dot p = -\dot m_c, \qquad (H_l - H_v)\dot V_l + E_p\,\dot p = Q,

        M_p = \rho_v'(V_t - V_l) + \rho_l'V_l, \qquad E_p = H_v'(V_t - V_l) + H_l'V_l - V_t

    M_p and E_p are the derivatives of mass and internal energy by p at constant V_l. The determinant
    (ρ_l − ρ_v)E_p − (H_l − H_v)M_p is positive: in a closed tank heat raises the pressure.

    Args:
        V_l: volume of the liquid [m³].
        volume: V_t [m³].
        tank: properties at the tank's pressure.
        slope: derivatives of the properties by pressure.
        flow: flow ṁ_c that leaves as liquid [kg/s].
        heating: sum Q of all terms of the enthalpy balance beside V_t ṗ [W].
    """
    V_v = volume - V_l
    M_V = tank.rho_l - tank.rho_v
    M_p = slope.rho_v * V_v + slope.rho_l * V_l
    E_V = tank.rho_l * tank.h_l - tank.rho_v * tank.h_v
    H_l_slope = slope.rho_l * tank.h_l + tank.rho_l * slope.h_l
    H_v_slope = slope.rho_v * tank.h_v + tank.rho_v * slope.h_v
    E_p = H_v_slope * V_v + H_l_slope * V_l - volume
    p_dot = (M_V * heating + E_V * flow) / (M_V * E_p - E_V * M_p)
    return (-flow - M_p * p_dot) / M_V, p_dot


def evaporation_heat(tank: Properties, flow: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    r"""Heat [W] that evaporates the vapour in the place of the vented liquid, ṁ_c (h_v − h_l) ρ_v/(ρ_l − ρ_v)."""
    return flow * (tank.h_v - tank.h_l) * tank.rho_v / (tank.rho_l - tank.rho_v)
