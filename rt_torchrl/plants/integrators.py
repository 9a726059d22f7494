"""The Runge-Kutta step, which is the same in the real system, the twin and every gradient engine."""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

RK4_REAL_STABILITY = 2.785
"""Length of the stability interval of a fourth-order, four-stage Runge-Kutta step on the negative real axis."""


def rk4_step(
    field: Callable[[Tensor, Tensor], Tensor],
    t: Float[Tensor, "*#batch"],
    state: Float[Tensor, "*batch n_s"],
    dt: float,
) -> Float[Tensor, "*batch n_s"]:
    r"""One step of Kutta's 3/8 rule, the tableau of torchdiffeq's ``rk4``.

    .. math::
        k_1 = f(t, s),\; k_2 = f(t+\tfrac h3, s+\tfrac h3k_1),\; k_3 = f(t+\tfrac{2h}3, s+h(k_2-\tfrac13k_1)),\;
        k_4 = f(t+h, s+h(k_1-k_2+k_3)),\quad s' = s + \tfrac h8(k_1+3k_2+3k_3+k_4)

    Args:
        field: the vector field f(t, s) [state unit / s].
        t: start of the step [s].
        state: state s at ``t``.
        dt: length h of the step [s].

    Source: Hairer, Nørsett, Wanner, *Solving Ordinary Differential Equations I*, table II.1.2.
    """
    third = dt / 3.0
    k1 = field(t, state)
    k2 = field(t + third, state + third * k1)
    k3 = field(t + 2.0 * third, state + dt * k2 - third * k1)
    k4 = field(t + dt, state + dt * (k1 - k2 + k3))
    return state + (k1 + 3.0 * (k2 + k3) + k4) * (dt / 8.0)
