"""Real episodes that are not to be learned from."""

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

FLIGHTS = 3
"""Real episodes in a row that may be refused; after as many, somebody has to look at the machine."""

GREATEST = torch.finfo(torch.float32).max
"""Of a number to be learned from: the long-term memory keeps its priorities in single precision."""

LEARNED = ("state", "exogenous", "observation", *(("next", k) for k in ("state", "observation", "applied", "reward")))
"""Entries of an episode that go into a memory."""


def refusal(episode: TensorDictBase) -> str | None:
    """Why an episode is not to be learned from; None where nothing speaks against it.

    A reading that a safety layer refuses as not finite or out of range is not what the system did. A number that is not
    finite in single precision would make a memory useless.

    Args:
        episode: one real episode, ``n``; ``("next", "refused")``, where it is there, marks the refused readings.
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
    """Note whether an episode is not to be learned from, and so is to be flown again.

    Args:
        refused: the reasons of the episodes before it in a row; its own is added.
        episode: see :func:`refusal`.

    Raises:
        ValueError: with the reasons, if there are now :data:`FLIGHTS` of them.
    """
    reason = refusal(episode)
    if reason is None:
        return False
    refused.append(reason)
    if len(refused) == FLIGHTS:
        raise ValueError(
            f"{FLIGHTS} real episodes in a row cannot be learned from: {'; '.join(refused)}. Nothing of them was "
            "stored; mend the sensor, or the ranges of the safety layer, and go on with the next episode."
        )
    return True


def finite_errors(td_errors: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """TD errors as the long-term memory may take them.

    Raises:
        ValueError: if one is not finite in single precision.
    """
    if not (td_errors.abs() <= GREATEST).all():
        raise ValueError(
            "the TD errors of an episode whose numbers are finite are not finite themselves: the critic has diverged. "
            "Nothing was stored; use smaller learning rates or a smaller reward_scale."
        )
    return td_errors
