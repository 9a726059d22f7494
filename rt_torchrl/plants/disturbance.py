"""The check that every model of an exogenous input makes before it draws."""

import math


def require_request(batch: int, n_steps: int, dt: float, *, least_steps: int = 1) -> None:
    """Refuse a draw of no episodes, of too few samples, or at a sampling interval that is not positive and finite.

    Args:
        batch: number of episodes.
        n_steps: number of samples of each episode.
        dt: sampling interval [s].
        least_steps: least number of samples that the model can draw.

    Raises:
        ValueError: if an argument is out of its range; the message names it.
    """
    if batch < 1:
        raise ValueError(f"batch={batch} must be at least 1.")
    if n_steps < least_steps:
        raise ValueError(f"n_steps={n_steps} must be at least {least_steps}; lengthen the episode or shorten dt.")
    if not (math.isfinite(dt) and dt > 0):
        raise ValueError(f"dt={dt} s must be positive and finite.")
