"""What every model of an exogenous input asks of whoever draws from it."""

import math


def require_request(batch: int, n_steps: int, dt: float, *, least_steps: int = 1) -> None:
    """Refuse a draw of no episodes, of episodes too short, or at a sampling interval that is none.

    Args:
        batch: number of episodes.
        n_steps: samples of each.
        dt: sampling interval [s].
        least_steps: fewest samples that the model can draw.

    Raises:
        ValueError: naming the argument that is out of its range.
    """
    if batch < 1:
        raise ValueError(f"batch={batch} must be at least 1.")
    if n_steps < least_steps:
        raise ValueError(f"n_steps={n_steps} must be at least {least_steps}; lengthen the episode or shorten dt.")
    if not (math.isfinite(dt) and dt > 0):
        raise ValueError(f"dt={dt} s must be positive and finite.")
