"""Refusal of numbers that must not be learned from."""

from jaxtyping import Float
from torch import Tensor

from rt_torchrl.systems.sound_part import GREATEST


def finite_errors(td_errors: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """The TD errors, which must be finite so that the long-term memory may take them.

    Raises:
        ValueError: if a TD error is not finite in single precision.
    """
    if not (td_errors.abs() <= GREATEST).all():
        raise ValueError(
            "the TD errors of an episode whose numbers are finite are not finite themselves: the critic has diverged. "
            "Nothing was stored; use smaller learning rates or a smaller reward_scale."
        )
    return td_errors
