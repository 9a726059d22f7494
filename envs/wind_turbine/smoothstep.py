"""A smooth step, with which torques fade in."""

from torch import Tensor


def smoothstep(x: Tensor) -> Tensor:
    """A step from 0 at x ≤ 0 to 1 at x ≥ 1 with a continuous slope, x²(3 − 2x) in between."""
    x = x.clamp(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
