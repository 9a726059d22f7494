"""The wind turbine in JAX; ``envs/wind_turbine/plant.py`` explains the equations."""

import math

import jax.numpy as jnp
from torch import nn

from benchmarking.jax_plants.jax_plant import Array, JaxPlant, Weights
from benchmarking.jax_plants.networks import bounded_perceptron, column, saturated, smooth_clip
from rt_torchrl.envs.wind_turbine.closures import SaintDrenan
from rt_torchrl.envs.wind_turbine.plant import WindTurbine


def wind_turbine(plant: WindTurbine, closure: nn.Module, policy: nn.Module) -> JaxPlant:
    """The plant with its constants, and its closures and policies with theirs."""
    greatest = column(plant.greatest_increment.numpy())

    def observe(state: Array) -> Array:
        return jnp.stack([_speed_error(plant, state[1], state[2]), state[3]])

    def actuate(state: Array, command: Array) -> Array:
        return state[4:6] + jnp.maximum(jnp.minimum(command - state[4:6], greatest), -greatest)

    def latch(state: Array, applied: Array) -> Array:
        return jnp.concatenate([state[:4], applied])

    def running_cost(state: Array, applied: Array) -> Array:
        omega_g = plant.gear_ratio * state[0]
        reference = jnp.minimum(plant.optimal_gain * omega_g**3, plant.rated_power)
        e1 = _speed_error(plant, state[1], state[2])
        e_P = (applied[0] * _cut_in(plant, omega_g) * omega_g - reference) / plant.rated_power
        return 0.5 * (e1**2 + e_P**2)

    policies = saturated(smooth_clip(policy.get_submodule("clip")))
    return JaxPlant(plant.dt, _field(plant), observe, actuate, latch, running_cost, _closures(closure), policies)


def _field(plant: WindTurbine):
    cutoff, window = 2.0 * math.pi * plant.filter_frequency, 2.0 * math.pi / plant.rated_rotor_speed
    standstill, thrust = plant.standstill_tip_speed_ratio, 0.5 * plant.air_density * math.pi * plant.radius**3

    def aerodynamic_torque(omega_r, beta, u, closure):
        lam = omega_r * plant.radius / u
        fade = _smoothstep(lam / standstill)
        lam = jnp.where(lam > 0.5 * standstill, lam, 0.5 * standstill)
        return thrust * fade * closure((lam, beta)) / lam * u**2

    def field(t, state, action, exogenous, closure):
        omega_r, omega_hat, u_hat, e2 = state[:4]
        (tau_g, beta), u = action, exogenous[0]
        omega_g = plant.gear_ratio * omega_r
        tau_a = aerodynamic_torque(omega_r, beta, u, closure)
        acceleration = (tau_a - plant.gear_ratio * tau_g * _cut_in(plant, omega_g)) / plant.inertia
        filters = cutoff * (omega_g - omega_hat), cutoff * (u - u_hat)
        integral, held = (_speed_error(plant, omega_hat, u_hat) - e2) / window, jnp.zeros_like(omega_r)
        return jnp.stack([acceleration, *filters, integral, held, held])

    return field


def _speed_error(plant: WindTurbine, omega_hat: Array, u_hat: Array) -> Array:
    best = plant.gear_ratio * plant.best_tip_speed_ratio * u_hat / plant.radius
    reference = jnp.clip(best, plant.minimum_generator_speed, plant.rated_generator_speed)
    return (omega_hat - reference) / plant.speed_error_scale


def _cut_in(plant: WindTurbine, omega_g: Array) -> Array:
    start = plant.cut_in_generator_speed - plant.cut_in_band
    return _smoothstep((omega_g - start) / (2.0 * plant.cut_in_band))


def _smoothstep(x: Array) -> Array:
    x = jnp.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _closures(module: nn.Module):
    correction = bounded_perceptron(getattr(module, "correction", None))
    law_module = module if isinstance(module, SaintDrenan) else module.get_submodule("law")
    scale, fixed = law_module.get_buffer("scale").numpy(), law_module.get_buffer("fixed").numpy()

    def law(weights: Weights, features, name: str = "scaled"):
        lam, beta = features
        scaled = jnp.concatenate([fixed, weights[name]])
        c1, c2, c3, c4, c5, c6, c7, c8, c9, c10 = scaled[:-1] * scale
        inverse_xi = 1.0 / (lam + c9 * beta) - c10 / (beta**3 + 1.0)
        power = (beta**2 + SaintDrenan.smallest_pitch**2) ** (0.5 * (1.0 + 0.5 * jnp.exp(scaled[-1])))
        bracket = c2 * inverse_xi - c3 * beta - c4 * beta / inverse_xi - c5 * power - c6
        return c1 * bracket * jnp.exp(-c7 * inverse_xi) + c8 * lam

    def mlp(weights: Weights, features):
        return law(weights, features, "law.scaled") + correction(weights, jnp.stack(features))[0]

    return {"law": law, "mlp": mlp}
