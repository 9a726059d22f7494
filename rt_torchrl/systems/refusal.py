"""Refusal of real episodes that must not be learned from."""

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

FLIGHTS = 3
"""Number of refused real episodes in a row after which somebody has to look at the machine."""

GREATEST = torch.finfo(torch.float32).max
"""Greatest number to be learned from: the long-term memory keeps its priorities in single precision."""

LEARNED = ("state", "exogenous", "observation", *(("next", k) for k in ("state", "observation", "applied", "reward")))
"""Entries of an episode that go into a memory."""


def refusal(episode: TensorDictBase) -> str | None:
    """The reason why an episode must not be learned from; None if there is none.

    A reading that a safety layer refuses as not finite or out of range does not show what the system did. A number that
    is not finite in single precision would make a memory useless.

    Args:
        episode: one real episode of batch size ``n``; its entry ``("next", "refused")``, if it has one, marks the
            refused readings.
    """
    if "refused" in episode["next"].keys():  # noqa: SIM118  (a TensorDict iterates over its batch)
        refused = episode["next", "refused"].flatten().nonzero().flatten().tolist()
        if refused:
            count, first = len(refused), refused[0]
            return f"the safety layer refused {count} of its readings, the first at the end of interval {first}"
    for key in LEARNED:
        wrong = ~(episode[key].abs() <= GREATEST)
        if wrong.any():
            value, k = episode[key][wrong][0].item(), wrong.nonzero()[0, 0].item()
            return f"{key} holds {value:g} in interval {k}, which is not finite in single precision"
    return None


def note_refusal(refused: list[str], episode: TensorDictBase) -> bool:
    """Whether an episode must not be learned from, and so must be flown again.

    Args:
        refused: reasons of the refused episodes just before this one; its own reason is added.
        episode: real episode, see :func:`refusal`.

    Raises:
        ValueError: if :data:`FLIGHTS` episodes in a row are refused; it gives their reasons.
    """
    reason = refusal(episode)
    if reason is None:
        return False
    refused.append(reason)
    if len(refused) == FLIGHTS:
        raise ValueError(
            f"{FLIGHTS} real episodes in a row cannot be learned from: {'; '.join(refused)}. None of them was stored; "
            "mend the sensor, or the ranges of the safety layer, and go on with the next episode."
        )
    return True


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
