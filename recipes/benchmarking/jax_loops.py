"""Trajectory, cost and gradient in JAX, compiled: one scan differentiated by JAX, and a reverse sweep by hand."""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from torch import nn

from benchmarking.case import System
from benchmarking.jax_plants.cryogenic_tank import cryogenic_tank
from benchmarking.jax_plants.flapping_wing import flapping_wing
from benchmarking.jax_plants.jax_plant import JaxPlant, Weights, interval
from benchmarking.jax_plants.wind_turbine import wind_turbine
from rt_torchrl import Scenario

Method = Literal["scan", "sweep"]
PLANTS = {"flapping_wing": flapping_wing, "wind_turbine": wind_turbine, "cryogenic_tank": cryogenic_tank}


class Inputs(NamedTuple):
    """A scenario with the time first and the realisations last."""

    initial_state: jax.Array
    t: jax.Array
    exogenous: jax.Array


class JaxLoops:
    """Forward and gradient of J_a by the policy's weights, jitted in double precision.

    Args:
        system: plant, closure and policy, whose weights are taken over.
        method: ``scan`` lets JAX differentiate the scan; ``sweep`` keeps the states alone and goes back over the
            intervals by hand, with one recomputed vector-Jacobian product each.
    """

    def __init__(self, system: System, method: Method):
        jax.config.update("jax_enable_x64", True)
        self.plant = PLANTS[system.case.plant](system.plant, system.closure, system.policy)
        self.closure_weights, self.weights = weights_of(system.closure), weights_of(system.policy)
        self.dt = system.plant.dt
        kinds = system.case.closure, system.case.policy
        step = functools.partial(_step, self.plant, *kinds)
        gradients = {"scan": _gradient_by_scan, "sweep": _gradient_by_sweep}
        self._forward = jax.jit(functools.partial(_forward, step))
        self._gradient = jax.jit(functools.partial(gradients[method], step))

    def inputs(self, scenario: Scenario) -> Inputs:
        """The scenario as arrays of JAX."""
        exogenous = jnp.asarray(scenario.exogenous.permute(1, 2, 0).numpy())
        t = self.dt * jnp.arange(len(exogenous), dtype=jnp.float64)
        return Inputs(jnp.asarray(scenario.initial_state.T.numpy()), t, exogenous)

    def forward(self, inputs: Inputs) -> tuple[jax.Array, jax.Array]:
        """Mean cost, and the states at the end of all intervals, ``n n_s batch``."""
        return jax.block_until_ready(self._forward(self.weights, self.closure_weights, inputs))

    def gradient(self, inputs: Inputs) -> tuple[jax.Array, Weights]:
        """Mean cost and its gradient by the policy's weights."""
        return jax.block_until_ready(self._gradient(self.weights, self.closure_weights, inputs))


def weights_of(module: nn.Module) -> Weights:
    """The weights of a module by name."""
    return {name: jnp.asarray(np.array(w.detach())) for name, w in module.named_parameters()}


def _step(plant: JaxPlant, closure: str, policy: str, weights: Weights, closure_weights: Weights) -> Callable:
    return interval(
        plant,
        functools.partial(plant.closures[closure], closure_weights),
        functools.partial(plant.policies[policy], weights),
    )


def _forward(step: Callable, weights: Weights, closure_weights: Weights, inputs: Inputs) -> tuple[Any, Any]:
    one = step(weights, closure_weights)

    def body(state, x):
        end, cost = one(x[0], state, x[1])
        return end, (end, cost)

    _, (ends, costs) = jax.lax.scan(body, inputs.initial_state, (inputs.t, inputs.exogenous))
    return costs.mean(), ends


def _gradient_by_scan(step: Callable, weights: Weights, closure_weights: Weights, inputs: Inputs) -> tuple[Any, Any]:
    return jax.value_and_grad(lambda w: _forward(step, w, closure_weights, inputs)[0])(weights)


def _gradient_by_sweep(step: Callable, weights: Weights, closure_weights: Weights, inputs: Inputs) -> tuple[Any, Any]:
    cost, ends = _forward(step, weights, closure_weights, inputs)
    starts = jnp.concatenate([inputs.initial_state[None], ends[:-1]])
    share = jnp.full(ends.shape[-1], 1.0 / (ends.shape[0] * ends.shape[-1]))

    def body(carry, x):
        costate, gradient = carry
        t, exogenous, state = x
        _, pull = jax.vjp(lambda s, w: step(w, closure_weights)(t, s, exogenous), state, weights)
        costate, part = pull((costate, share))
        return (costate, jax.tree.map(jnp.add, gradient, part)), None

    first = jnp.zeros_like(inputs.initial_state), jax.tree.map(jnp.zeros_like, weights)
    (_, gradient), _ = jax.lax.scan(body, first, (inputs.t, inputs.exogenous, starts), reverse=True)
    return cost, gradient
