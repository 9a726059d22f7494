"""The cryogenic tank in JAX; ``envs/cryogenic_tank/plant.py`` explains the equations."""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from torch import nn

from benchmarking.jax_plants.jax_plant import Array, JaxPlant, Weights
from benchmarking.jax_plants.networks import bounded_perceptron, saturated, smooth_clip
from rt_torchrl.envs.cryogenic_tank.closures import CubicVentLaw
from rt_torchrl.envs.cryogenic_tank.plant import (
    EXCHANGER_AREA,
    LAMINAR_DROP,
    ROUNDING_DROP,
    CryogenicTank,
    PressureCost,
)
from rt_torchrl.envs.cryogenic_tank.saturation import CELLS, DEGREE, Saturation

VENTED = PressureCost().vented


class Properties(NamedTuple):
    """Properties of the saturated fluid, or their slopes per Pa."""

    T: Array
    rho_l: Array
    rho_v: Array
    h_l: Array
    h_v: Array


def cryogenic_tank(plant: CryogenicTank, closure: nn.Module, policy: nn.Module) -> JaxPlant:
    """The plant with the explicit wall and its constants, and its closures and policies with theirs."""

    def observe(state: Array) -> Array:
        return (state[2:] - plant.set_point) / plant.error_unit

    def running_cost(state: Array, applied: Array) -> Array:
        p = state[2]
        drop = p - _outlet(plant, p, applied[0])
        e = observe(state)[0]
        return e**2 + VENTED * drop * _conductance(drop, plant.rated_valve)

    def same_action(state: Array, command: Array) -> Array:
        return command

    def same_state(state: Array, applied: Array) -> Array:
        return state

    clip = smooth_clip(policy.get_submodule("clip"))

    def cubic(weights: Weights, e: Array) -> Array:
        share, (linear, cube, offset) = e / CubicVentLaw.reference_error, weights["scaled"]
        return clip(linear * share + cube * share**3 + offset)

    policies = {**saturated(clip), "affine": cubic}  # the plant's own policy, which is a cubic
    closures = _closures(closure)
    return JaxPlant(plant.dt, _field(plant), observe, same_action, same_state, running_cost, closures, policies)


def _field(plant: CryogenicTank):
    properties = _saturation(plant.saturation)
    volume = plant.volume

    def field(t, state, action, exogenous, closure):
        T_s, V_l, p = state
        drop = p - _outlet(plant, p, action[0])
        tank, slope, line = properties(p, p - drop)
        superheat, opening = (T_s - tank.T) / plant.superheat_unit, action[0] / plant.actions[0].high
        U_s, U_HX, K_JT = closure((p / plant.set_point, V_l / volume, superheat, opening))
        Q_sf = U_s * plant.wall_area * (T_s - tank.T)
        flow, heat = _vent(drop, tank, line, slope.T, U_HX, K_JT)
        rates = _mixture_rates(V_l, volume, tank, slope, flow, Q_sf - flow * tank.h_l - heat)
        return jnp.stack([(exogenous[0] - Q_sf) / plant.wall_heat_capacity, *rates])

    return field


def _outlet(plant: CryogenicTank, p: Array, drop: Array) -> Array:
    return jnp.where(p - drop < plant.back_pressure, plant.back_pressure, p - drop)


def _conductance(drop: Array, K_JT: Array) -> Array:
    return 1.0 / jnp.sqrt(K_JT * jnp.sqrt(drop**2 + LAMINAR_DROP**2))


def _vent(drop: Array, tank: Properties, line: Properties, T_slope: Array, U_HX: Array, K_JT: Array):
    conductance, measurable = _conductance(drop, K_JT), drop > ROUNDING_DROP
    secant = jnp.where(measurable, (tank.T - line.T) / jnp.where(measurable, drop, ROUNDING_DROP), T_slope)
    latent, flow = line.h_v - tank.h_l, conductance * drop
    effectiveness = -jnp.expm1(-U_HX * EXCHANGER_AREA * secant / (conductance * latent))
    return flow, effectiveness * flow * latent


def _mixture_rates(V_l: Array, volume: float, tank: Properties, slope: Properties, flow: Array, heating: Array):
    V_v, M_V = volume - V_l, tank.rho_l - tank.rho_v
    M_p = slope.rho_v * V_v + slope.rho_l * V_l
    E_V = tank.rho_l * tank.h_l - tank.rho_v * tank.h_v
    H_l_slope = slope.rho_l * tank.h_l + tank.rho_l * slope.h_l
    H_v_slope = slope.rho_v * tank.h_v + tank.rho_v * slope.h_v
    E_p = H_v_slope * V_v + H_l_slope * V_l - volume
    p_dot = (M_V * heating + E_V * flow) / (M_V * E_p - E_V * M_p)
    return (-flow - M_p * p_dot) / M_V, p_dot


def _saturation(module: Saturation) -> Callable[[Array, Array], tuple[Properties, Properties, Properties]]:
    """A function from the pressures of tank and line to the properties and slopes of the one, and those of the other.

    It evaluates only what the equations use: no slopes in the line.
    """
    table, width = jnp.asarray(module.table.numpy()), math.log(module.high / module.low) / CELLS

    def place(p: Array) -> tuple[Array, Array]:
        x = jnp.where((p >= module.low) & (p <= module.high), jnp.log(p / module.low) / width, jnp.nan)
        cell = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, CELLS - 1)
        return table[cell], (x - cell)[..., None]

    def properties(p: Array, p_1: Array) -> tuple[Properties, Properties, Properties]:
        c, u = place(jnp.stack([p, p_1]))
        value, slope = c[..., DEGREE, :], jnp.zeros_like(c[0, ..., DEGREE, :])
        for power in range(DEGREE - 1, -1, -1):
            slope = slope * u[0] + value[0]
            value = value * u + c[..., power, :]
        slope = slope / (width * p)[..., None]
        return tuple(Properties(*jnp.moveaxis(x, -1, 0)) for x in (value[0], slope, value[1]))

    return properties


def _closures(module: nn.Module):
    correction = bounded_perceptron(getattr(module, "correction", None))

    def law(weights: Weights, features):
        return jnp.exp(weights["log_coefficients"])

    def mlp(weights: Weights, features):
        constants = jnp.exp(weights["constants.log_coefficients"])
        return constants[:, None] * jnp.exp2(correction(weights, jnp.stack(features)))

    return {"law": law, "mlp": mlp}
