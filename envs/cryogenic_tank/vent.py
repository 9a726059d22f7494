r"""The thermodynamic vent: Joule-Thomson valve and heat exchanger (paper, section 5.3)."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.envs.cryogenic_tank.saturation import Properties

EXCHANGER_AREA = 200 * math.pi * 0.005 * 2.0
"""A_HX = 6.28 m²: 200 tubes of 5 mm by 2 m."""
LAMINAR_DROP = 100.0
"""δ [Pa]: pressure drop below which the flow through the valve is laminar."""
ROUNDING_DROP = 1.0
"""Pressure drop [Pa] below which a difference of two temperatures is no more accurate than their slope."""


class Vent(NamedTuple):
    """The flows and the heat that the vent takes from the tank."""

    flow: Tensor  # ṁ_c [kg/s]
    heat: Tensor  # Q_HX [W], positive: it cools the liquid
    effectiveness: Tensor  # ε [-]
    pump_flow: Tensor  # ṁ_h [kg/s]


def vent(
    drop: Float[Tensor, "*batch"],
    tank: Properties,
    line: Properties,
    T_slope: Float[Tensor, "*batch"],
    U_HX: Float[Tensor, "*batch"],
    K_JT: Float[Tensor, "*batch"],
) -> Vent:
    r"""Vented flow and heat taken from the liquid that the pump circulates.

    .. math::
        \dot m_c = \sqrt{\Delta p_V/K_{JT}}, \quad Q_{HX} = \varepsilon\,\dot m_c\,\Delta h_c, \quad
        \varepsilon = 1 - e^{-NTU}, \quad NTU = \frac{U_{HX}A_{HX}\,\Delta T}{\dot m_c\,\Delta h_c}, \quad
        \dot m_h = \frac{\Delta h_c}{c_{p,l}\,\Delta T}\dot m_c

    with :math:`\Delta h_c = h_v(p_1) - h_l(p)` and :math:`\Delta T = T(p) - T(p_1)`. The ratio ΔT/ṁ_c is taken as
    (ΔT/Δp_V)/(ṁ_c/Δp_V), both of which have a limit when the valve shuts.

    Note: the paper prints the exchanged heat as ε c_p ΔT; here it is ε ṁ_c Δh_c, which equals ε ṁ_h c_p ΔT with the
    missing ṁ_h, because this form stays finite when the valve shuts.

    Args:
        drop: pressure drop p − p_1 [Pa], not negative.
        tank: properties at the tank's pressure p.
        line: properties behind the valve, at p_1.
        T_slope: slope dT/dp at p [K/Pa], the limit of ΔT/Δp_V.
        U_HX: heat transfer coefficient of the exchanger [W/(m² K)].
        K_JT: constant of the valve [Pa s²/kg²].
    """
    conductance = valve_conductance(drop, K_JT)
    measurable = drop > ROUNDING_DROP
    secant = torch.where(measurable, (tank.T - line.T) / torch.where(measurable, drop, ROUNDING_DROP), T_slope)
    latent = line.h_v - tank.h_l
    flow = conductance * drop
    effectiveness = -torch.expm1(-U_HX * EXCHANGER_AREA * secant / (conductance * latent))
    return Vent(flow, effectiveness * flow * latent, effectiveness, conductance * latent / (tank.c_p * secant))


def valve_conductance(drop: Float[Tensor, "*batch"], K_JT: Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
    r"""Conductance ṁ_c/Δp_V [kg/(s Pa)] of the valve, :math:`\big(K_{JT}\sqrt{\Delta p_V^2 + \delta^2}\big)^{-1/2}`.

    Note: the paper prints ṁ_c = √(Δp_V/K_JT), the case δ = 0; here δ is 100 Pa, because the root has an infinite slope
    at zero. The flow is then proportional to the drop far below δ, as laminar flow is, and 8e-6 less than the root at
    18 kPa.
    """
    return (K_JT * (drop**2 + LAMINAR_DROP**2) ** 0.5) ** -0.5
