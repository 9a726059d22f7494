"""The actuators of the wind turbine: how fast torque and pitch may change."""

import math
from collections.abc import Sequence

from rt_torchrl.options import require_range
from rt_torchrl.plants.signal import Signal

SLOWEST = 100.0
"""Time that no actuator of a turbine takes for its whole range [s]."""


def require_rates(actions: Sequence[Signal], rates: tuple[float, float] | None) -> None:
    """Refuse rate limits that are none, or with which an actuator takes longer than ``SLOWEST`` for its whole range.

    Args:
        actions: torque and pitch, with their ranges.
        rates: greatest |dτ_g/dt| [N m/s] and |dβ/dt| [deg/s]; None for ideal actuators.

    Raises:
        ValueError: if a rate is not positive, or that slow.
    """
    if rates is None:
        return
    if not min(rates) > 0:
        raise ValueError(f"rate_limits={rates} (N m/s, deg/s) must be positive; None means ideal actuators.")
    for action, rate in zip(actions, rates, strict=True):
        least, of = (action.high - action.low) / SLOWEST, f"the actuator of {action.name}"
        require_range("rate_limits", rate, least, math.inf, unit=f"{action.unit}/s", of=of)
