"""The length of an episode in control intervals."""

import math

from rt_torchrl.options import require_number

MOST_STEPS = 10_000_000
"""Control intervals of the longest episode; a hundred numbers for each interval take 8 GB."""


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
    steps = round(horizon / dt)
    if steps < 1 or abs(steps * dt - horizon) > 1e-6 * dt:
        raise ValueError(
            f"horizon={horizon} s of plant {plant!r} must be a whole number of steps dt={dt} s; "
            f"try {max(1, steps) * dt} s."
        )
    return steps
