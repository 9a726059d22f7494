"""The sound part of a real episode: the intervals that show what the system did, and the faults of the others.

What is not finite is refused on the way to a learner.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool
from tensordict import TensorDictBase
from torch import Tensor

from rt_torchrl.plants.plant import Plant
from rt_torchrl.systems.safety import SafetyReport

GREATEST = torch.finfo(torch.float32).max
"""Greatest number to be learned from: the long-term memory keeps its priorities in single precision."""
LEARNED = ("state", "exogenous", "observation", *(("next", k) for k in ("state", "observation", "applied", "reward")))
"""Entries of an episode that go into a memory."""
FAULTS = ("missing", "not finite", "out of range", "frozen", "late", "limit", "asked")
"""Reasons of a safety layer's events that are faults of the system, or of a policy that asks for no number."""
FLIGHTS = 3
"""Number of real episodes in a row with too few right readings after which somebody has to look at the machine."""


class Fault(NamedTuple):
    """A fault of the real system in one control interval.

    ``kind`` is a reason of :class:`SafetyEvent`, ``ended`` where the system failed or ended the episode early, or
    ``overflow`` where a number is not finite in single precision.
    """

    kind: str
    interval: int
    time: float  # start of the interval, counted from the start of the episode [s]
    detail: str


class EpisodeEndedError(ValueError):
    """The error of a real episode that has not reached its horizon: the system failed, or ended it.

    Args:
        message: what happened.
        flown: the episode up to there; None if no interval was finished.
    """

    def __init__(self, message: str, flown: TensorDictBase | None):
        super().__init__(message)
        self.flown = flown


class SoundPart(NamedTuple):
    """What can be learned from a real episode.

    ``parts`` holds the first interval, and the one after the last, of each sound part; ``longest`` is the longest one.
    ``whole`` says whether all intervals are sound, to the horizon or to the early end of the episode; ``reason`` says
    why not.
    """

    parts: list[tuple[int, int]]
    faults: list[Fault]
    reason: str
    whole: bool

    @property
    def longest(self) -> tuple[int, int]:
        """The longest part, the first of several; (0, 0) if there is none."""
        return max(self.parts, key=lambda part: part[1] - part[0], default=(0, 0))


def sound_part(episode: TensorDictBase, plant: Plant, report: SafetyReport | None) -> SoundPart:
    """The intervals of an episode whose readings, at their start and at their end, are right.

    A reading that a safety layer refuses does not show what the system did. A number that is not finite in single
    precision would make a memory useless.

    Args:
        episode: one real episode of batch size ``n``, or its first intervals; its entry ``("next", "refused")``, if it
            has one, marks the refused readings.
        plant: plant that gives the length of an episode and the control interval.
        report: report of the safety layer about this episode, if there is one.
    """
    n = len(episode)
    # At the end of a refused interval a safety layer has refused the reading; it may say so later in its report.
    refused = torch.zeros(n, dtype=torch.bool, device="cpu")
    if "refused" in episode["next"].keys():  # noqa: SIM118  (a TensorDict iterates over its batch)
        refused = episode["next", "refused"].flatten().cpu().clone()
    refused[[k for k in (report.wrong if report is not None else ()) if k < n]] = True
    overflow, overflows = _overflows(episode, plant.dt)
    wrong = refused | overflow
    wrong[1:] |= refused[:-1]  # what is read at the end of an interval is the start of the next one
    if "refused" in episode.keys():  # noqa: SIM118
        wrong[:1] |= episode["refused"][:1].flatten().cpu()  # of the window before, where nothing was reset
    reasons = []
    if refused.any():
        at = refused.nonzero().flatten().tolist()
        reasons.append(f"the safety layer refused {len(at)} of its readings, the first at the end of interval {at[0]}")
    reasons += [fault.detail for fault in overflows][:1]
    sound = (~wrong).tolist()
    starts = [k for k, good in enumerate(sound) if good and (k == 0 or not sound[k - 1])]
    ends = [k + 1 for k, good in enumerate(sound) if good and (k + 1 == n or not sound[k + 1])]
    over = plant.end_cost is not None and bool(episode["next", "terminated"][-1].any())
    whole = (n == plant.n_steps or over) and all(sound)
    parts = list(zip(starts, ends, strict=True))
    return SoundPart(parts, _reported(report) + overflows, "; ".join(reasons), whole)


def _overflows(episode: TensorDictBase, dt: float) -> tuple[Bool[Tensor, " n"], list[Fault]]:
    """The intervals with numbers that are not finite in single precision, and a fault for each of their entries."""
    wrong, faults = torch.zeros(len(episode), dtype=torch.bool, device="cpu"), []
    for key in LEARNED:
        beyond = ~(episode[key].abs() <= GREATEST)
        rows = beyond.flatten(1).any(-1).cpu()
        if rows.any():
            k, value = int(rows.nonzero()[0, 0]), episode[key][beyond][0].item()
            detail = f"{key} holds {value:g} in interval {k}, which is not finite in single precision"
            faults.append(Fault("overflow", k, k * dt, detail))
        wrong |= rows
    return wrong, faults


def _reported(report: SafetyReport | None) -> list[Fault]:
    """The faults of a safety layer's report; a stretch of intervals with the same fault is one, at its beginning."""
    faults: list[Fault] = []
    last: dict[str, int] = {}
    for event in report.events if report is not None else ():
        for kind, detail in event.reasons.items():
            if kind not in FAULTS:
                continue
            if last.get(kind) != event.step - 1:
                faults.append(Fault(kind, event.step, event.time, detail))
            last[kind] = event.step
    return faults


def tried_in_vain(reasons: Sequence[str]) -> str:
    """The error of several real episodes in a row that say too little."""
    return (
        f"{len(reasons)} real episodes in a row cannot be used: {'; '.join(dict.fromkeys(reasons))}. None of "
        "them was stored; mend the system, its sensors, or the ranges of the safety layer, and go on with the next "
        "episode."
    )
