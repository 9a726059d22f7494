"""The watchdog judges the observations of a real system: are they finite, within their ranges, in order and in time?"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from rt_torchrl.options import require_number
from rt_torchrl.systems.sample_check import SampleCheck

ROUNDING = 1e-9
"""Slack in comparisons of times that are sums of intervals [s]."""

Range = tuple[float | Sequence[float], float | Sequence[float]]


class Watchdog:
    """A watchdog that trips at a fault and stays tripped until it has seen no fault for the hold time.

    Args:
        ranges: least and greatest admissible value of each entry, by name; each is one number for all components or
            one number for each component.
        deadline: longest wall-clock time from an action to the observation of its effect [s].
        hold: time without a fault after which the watchdog is released [s]; infinity never releases it.
        patience: time for which the watchdog may stay tripped without a break; after it :meth:`exhausted` is true [s].
        limits: least and greatest value of entries between which the system is to stay, as ``ranges``; beyond them a
            reading is right, and the system is not.
        samples: check of the order of the readings; None leaves it out.

    Raises:
        ValueError: if a time is out of its range, or the low end of a range is not below its high end.
    """

    def __init__(
        self,
        ranges: Mapping[str, Range],
        *,
        deadline: float = math.inf,
        hold: float = 0.0,
        patience: float = math.inf,
        limits: Mapping[str, Range] | None = None,
        samples: SampleCheck | None = None,
    ):
        for argument, value in (("deadline", deadline), ("hold", hold), ("patience", patience)):
            require_number(argument, value, finite=False)
        if not deadline > 0.0:
            raise ValueError(f"deadline={deadline} s must be positive; infinity waits for ever.")
        for argument, value in (("hold", hold), ("patience", patience)):
            if not value >= 0.0:
                raise ValueError(f"{argument}={value} s must be a number that is not negative; infinity is one.")
        self._ranges, self._limits = _ends("range", ranges), _ends("limit", limits or {})
        self.samples = samples or SampleCheck()
        self.deadline, self.hold, self.patience = deadline, hold, patience
        self.begin()

    def begin(self) -> None:
        """Begin a new episode, in which no fault has been seen."""
        self._since, self._until = math.inf, -math.inf
        self.samples.begin()

    def faults(self, entries: Mapping[str, Tensor], elapsed: float) -> dict[str, str]:
        """Faults of an observation by kind, each with a detail.

        Args:
            entries: entries of the observation.
            elapsed: wall-clock time that the observation took to come [s].
        """
        found = {}
        broken = [name for name, value in entries.items() if not value.isfinite().all()]
        if broken:
            found["not finite"] = ", ".join(broken)
        for kind, ends in (("out of range", self._ranges), ("limit", self._limits)):
            outside = [name for name in ends if name in entries and not _inside(entries[name], ends[name])]
            if outside:
                found[kind] = ", ".join(outside)
        found |= self.samples.faults(entries)
        if elapsed > self.deadline:
            found["late"] = f"{elapsed:.6g} s, deadline {self.deadline:g} s"
        return found

    def note(self, t: float, faulty: bool) -> None:
        """Take note of an observation at time t of the episode [s] and whether it was faulty."""
        if faulty:
            self._since = min(self._since, t)
            # Without a hold time the watchdog is tripped for the interval that begins now.
            self._until = t + max(self.hold, 2.0 * ROUNDING)
        elif not self.tripped(t):
            self._since = math.inf

    def tripped(self, t: float) -> bool:
        """Whether the fallback acts in the interval that begins at t [s]."""
        return t < self._until - ROUNDING

    def exhausted(self, t: float) -> bool:
        """Whether the watchdog has been tripped, at t [s], for as long as its patience."""
        return self.tripped(t) and t - self._since >= self.patience - ROUNDING


def _ends(what: str, ranges: Mapping[str, Range]) -> dict[str, tuple[Tensor, Tensor]]:
    """Both ends of ranges as tensors, the low one below the high one."""
    found = {}
    for entry, ends in ranges.items():
        low, high = (torch.as_tensor(end, dtype=torch.float64) for end in ends)
        if not (low < high).all():
            raise ValueError(f"{what} of {entry!r} is {low.tolist()} to {high.tolist()}; low must be below high.")
        found[entry] = (low, high)
    return found


def _inside(value: Tensor, ends: tuple[Tensor, Tensor]) -> bool:
    low, high = (end.to(value) for end in ends)
    # A value that is not finite is a fault of its own.
    return bool(((value >= low) & (value <= high) | ~value.isfinite()).all())
