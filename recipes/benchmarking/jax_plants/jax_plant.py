"""A plant as the loops in JAX need it, with its closure and policy."""

from collections.abc import Callable
from typing import Any, NamedTuple

Weights = dict[str, Any]
Array = Any


class JaxPlant(NamedTuple):
    """The functions of a plant in the notation of :class:`rt_torchrl.Plant`, with components first.

    Args:
        dt: control interval [s].
        field: vector field f(t, s, a, z, g) with the closure g(features) -> coefficients.
        observe: observation of a state.
        actuate: applied action of a state and a command.
        latch: end state with what the actuators remember of the applied action.
        running_cost: L_a of a state and an applied action.
        closures: the closure of each kind, g(weights, features).
        policies: the policy of each kind, a(weights, observation).
    """

    dt: float
    field: Callable[..., Array]
    observe: Callable[[Array], Array]
    actuate: Callable[[Array, Array], Array]
    latch: Callable[[Array, Array], Array]
    running_cost: Callable[[Array, Array], Array]
    closures: dict[str, Callable[[Weights, Array], Array]]
    policies: dict[str, Callable[[Weights, Array], Array]]


def interval(plant: JaxPlant, closure: Callable[[Array], Array], policy: Callable[[Array], Array]) -> Callable:
    """One control interval, (t, s, z) to the end state and the running cost at its start."""

    def step(t: Array, state: Array, exogenous: Array) -> tuple[Array, Array]:
        applied = plant.actuate(state, policy(plant.observe(state)))

        def field(t: Array, state: Array) -> Array:
            return plant.field(t, state, applied, exogenous, closure)

        end = plant.latch(rk4_step(field, t, state, plant.dt), applied)
        return end, plant.running_cost(state, applied)

    return step


def rk4_step(field: Callable[[Array, Array], Array], t: Array, state: Array, dt: float) -> Array:
    """One step of Kutta's 3/8 rule."""
    third = dt / 3.0
    k1 = field(t, state)
    k2 = field(t + third, state + third * k1)
    k3 = field(t + 2.0 * third, state + dt * k2 - third * k1)
    k4 = field(t + dt, state + dt * (k1 - k2 + k3))
    return state + (k1 + 3.0 * (k2 + k3) + k4) * (dt / 8.0)
