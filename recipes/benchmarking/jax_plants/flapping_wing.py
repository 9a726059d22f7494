"""The flapping-wing drone in JAX; ``envs/flapping_wing/plant.py`` explains the equations."""

import math

import jax.numpy as jnp
import numpy as np
from torch import nn

from benchmarking.jax_plants.jax_plant import Array, JaxPlant, Weights
from benchmarking.jax_plants.networks import bounded_perceptron, column, saturated, smooth_clip
from rt_torchrl.envs.flapping_wing.plant import WINDOW_WIDTH, FlappingWing


def flapping_wing(plant: FlappingWing, closure: nn.Module, policy: nn.Module) -> JaxPlant:
    """The plant with its constants, and its closures and policies with theirs."""
    target, dt = column(plant.target.numpy()), plant.dt
    scale = column(np.array([measurement.scale for measurement in plant.observed]))
    field, closures = _field(plant), _closures(closure)

    def observe(state: Array) -> Array:
        return jnp.concatenate([target - state[:2], -state[2:]]) / scale

    def running_cost(state: Array, applied: Array) -> Array:
        e = target - state[:2]
        h = jnp.exp(-0.5 * (e / WINDOW_WIDTH) ** 2)
        return 0.5 * ((e**2).sum(0) + ((state[2:] * h) ** 2).sum(0))

    policies = saturated(smooth_clip(policy.get_submodule("clip")))
    return JaxPlant(dt, field, observe, _same_action, _same_state, running_cost, closures, policies)


def _same_action(state: Array, command: Array) -> Array:
    return command


def _same_state(state: Array, applied: Array) -> Array:
    return state


def _field(plant: FlappingWing):
    radius, strip_mass = plant.radius.numpy(), plant.strip_mass.numpy()
    mass, weight = float(plant.mass), float(plant.weight[1])
    rate, epsilon = 2.0 * math.pi * plant.frequency, plant.smallest_airspeed**2
    body = 0.5 * plant.air_density * plant.body_drag_area

    def wing_force(v_x, v_z, phi_dot, alpha, closure):
        # The nodes come last: with them first, the same loops take up to 2.6 times as long.
        U_x, U_z = v_x[:, None] - phi_dot[:, None] * radius, v_z[:, None]
        sine, cosine = jnp.sin(alpha), jnp.cos(alpha)
        U_xi, U_zeta = cosine * U_x - sine * U_z, sine * U_x + cosine * U_z
        speed = jnp.sqrt(U_x**2 + U_z**2 + epsilon)
        C_L, C_D = closure((U_xi / speed, U_zeta / speed))
        pressure = strip_mass * speed
        return -(pressure * (C_D * U_x + C_L * U_z)).sum(-1), (pressure * (C_L * U_x - C_D * U_z)).sum(-1)

    def field(t, state, action, exogenous, closure):
        v_x, v_z = state[2] + exogenous[0], state[3]
        A_phi, beta_w = jnp.deg2rad(action[0]), jnp.deg2rad(action[1])
        sine, cosine = jnp.sin(rate * t), jnp.cos(rate * t)
        cos_phi, phi_dot = jnp.cos(A_phi * cosine), -rate * A_phi * sine
        sin_beta, cos_beta = jnp.sin(beta_w), jnp.cos(beta_w)
        stroke_x, stroke_z = cos_beta * v_x + sin_beta * v_z, cos_beta * v_z - sin_beta * v_x
        alpha = math.radians(plant.pitching_amplitude) * sine
        F_x, F_z = wing_force(cos_phi * stroke_x, stroke_z, phi_dot, alpha, closure)
        drag = body * jnp.sqrt(v_x**2 + v_z**2 + epsilon)
        force_x = cos_beta * cos_phi * F_x - sin_beta * F_z - drag * v_x
        force_z = sin_beta * cos_phi * F_x + cos_beta * F_z - drag * v_z
        return jnp.stack([state[2], state[3], force_x / mass, (force_z + weight) / mass])

    return field


def _closures(module: nn.Module):
    correction = bounded_perceptron(getattr(module, "correction", None))

    def law(weights: Weights, features, name: str = "log_coefficients"):
        sine, cosine = features
        a, b, c = jnp.exp(weights[name])
        return 2.0 * a * sine * cosine, b + 2.0 * c * sine**2

    def mlp(weights: Weights, features):
        sine, cosine = features
        C_L, C_D = law(weights, features, "law.log_coefficients")
        lift, drag = (part.reshape(cosine.shape) for part in correction(weights, cosine.reshape(1, -1)))
        return C_L + sine * lift, C_D * jnp.exp(drag)

    return {"law": law, "mlp": mlp}
