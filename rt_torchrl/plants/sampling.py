"""Sampled time: the Runge-Kutta step and its stability, the length of an episode, draws and lags of records."""

import math
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.options import require_number
from rt_torchrl.plants.shapes import Draws, State, Time

RK4_REAL_STABILITY = 2.785
"""Length of the stability interval of a fourth-order, four-stage Runge-Kutta step on the negative real axis."""
MOST_STEPS = 10_000_000
"""Control intervals of the longest episode; a hundred numbers for each interval take 8 GB."""


def rk4_step(field: Callable[[Tensor, Tensor], Tensor], t: Time, state: State, dt: float) -> State:
    r"""One step of Kutta's 3/8 rule, the tableau of torchdiffeq's ``rk4``, in real system, twin and all engines.

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


def require_stable_step(plant: str, dt: float, rate: float, *, mode: str, remedy: str) -> None:
    """Refuse a step that makes an explicit Runge-Kutta step unstable.

    Args:
        plant: name of the plant, for the message.
        dt: step [s].
        rate: fastest decay rate |Re μ| of the linearised plant [1/s].
        mode: name of the state that decays at that rate, for the message.
        remedy: another remedy than a smaller step, for the message.

    Raises:
        ValueError: if dt·rate exceeds the stability limit of RK4 on the negative real axis, 2.785.
    """
    if dt * rate > RK4_REAL_STABILITY:
        raise ValueError(
            f"dt={dt} s makes plant {plant!r} unstable: {mode} decays at {rate:.4g} 1/s, so dt·rate = {dt * rate:.3g} "
            f"exceeds the limit {RK4_REAL_STABILITY} of an explicit fourth-order Runge-Kutta step. "
            # The share keeps the rounded advice below the limit.
            f"Use dt <= {0.995 * RK4_REAL_STABILITY / rate:.3g} s, or {remedy}."
        )


def whole_multiple(argument: str, seconds: float, unit: float) -> int:
    """The number of units that a time is.

    Args:
        argument: name of the time, for the message.
        seconds: the time [s].
        unit: the unit, such as a control interval [s].

    Raises:
        ValueError: if the time is no whole multiple of the unit.
    """
    count = round(seconds / unit) if math.isfinite(seconds) else 0
    if count < 1 or abs(count * unit - seconds) > 1e-6 * unit:
        nearest = max(1, count) * unit
        raise ValueError(f"{argument}={seconds} s must be a whole multiple of {unit:.9g} s, such as {nearest:.9g} s.")
    return count


def whole_steps(plant: str, dt: float, horizon: float) -> int:
    """The number of control intervals in an episode.

    Args:
        plant: name of the plant, for the message.
        dt: control interval Δt [s].
        horizon: length of an episode T_o [s].

    Raises:
        ValueError: if an argument is not positive, or the horizon is no multiple of ``dt`` or exceeds ``MOST_STEPS``
            intervals.
    """
    for argument, value in (("dt", dt), ("horizon", horizon)):
        require_number(argument, value, finite=False)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{argument}={value} s of plant {plant!r} must be positive and finite.")
    if not horizon / dt <= MOST_STEPS:
        raise ValueError(
            f"horizon={horizon} s of plant {plant!r} is {horizon / dt:.3g} steps dt={dt} s; it must be at most "
            f"{MOST_STEPS:.0e}, because an episode is kept in memory."
        )
    return whole_multiple("horizon", horizon, dt)


@runtime_checkable
class DisturbanceModel(Protocol):
    """Anything that draws histories of an exogenous input, such as a wind or a heat load."""

    def draw(self, batch: int, n_steps: int, dt: float, generator: torch.Generator) -> Draws:
        """The input in ``batch`` episodes at the times 0, dt, …, (n_steps − 1)·dt, in the unit of its signal."""


def between(values: Float[Tensor, " samples"]) -> Float[Tensor, " n"]:
    """The mean of the values at both ends of every interval."""
    return 0.5 * (values[1:] + values[:-1])


def lag(start: Tensor, driving: Float[Tensor, " n"], steps: float) -> Float[Tensor, " samples"]:
    r"""A first-order lag of a recorded signal, such as a filter; ``steps`` is Δt over its time constant.

    .. math:: \hat y_{k+1} = e^{-\Delta t/T}\hat y_k + (1 - e^{-\Delta t/T})\,\bar y_k
    """
    from scipy.signal import lfilter  # imported here: loading takes a second, and only logs need it

    decay = math.exp(-steps)
    ends, _ = lfilter([1.0 - decay], [1.0, -decay], driving.numpy(), zi=[decay * start.item()])
    return torch.cat([start.reshape(1), torch.from_numpy(ends)])
