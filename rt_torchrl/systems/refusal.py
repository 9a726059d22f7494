"""Refusal of numbers that must not be learned from."""

from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

from rt_torchrl.systems.sound_part import GREATEST


def finite_transitions(transitions: TensorDictBase) -> TensorDictBase:
    """The transitions, whose numbers must be finite so that a learner may take them.

    Raises:
        ValueError: if one is not finite in single precision; it names the first one.
    """
    for key, values in transitions.items(include_nested=True, leaves_only=True):
        if not values.is_floating_point():
            continue
        wrong = ~(values.abs() <= GREATEST)
        if wrong.any():
            k = int(wrong.flatten(1).any(-1).nonzero()[0, 0])
            raise ValueError(
                f"{key!r} of transition {k} is {values[k][wrong[k]][0].item():g}; what a learner stores must be finite "
                f"and at most {GREATEST:.3g} in size. Nothing was stored; leave out what was not measured."
            )
    return transitions


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
