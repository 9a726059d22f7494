"""Judges the observations of a real system: are they numbers, within their ranges, and in time?"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

ROUNDING = 1e-9
"""Slack of times that are sums of intervals [s]."""

Range = tuple[float | Sequence[float], float | Sequence[float]]


class Watchdog:
    """Trips at a fault and stays tripped until no fault has been seen for the hold time.

    Args:
        ranges: least and greatest admissible value of entries, for all components or one by one.
        deadline: longest wall-clock time from an action to the observation of what it did [s].
        hold: time without a fault after which it is released [s]; infinity for never.
        patience: time after which :meth:`exhausted` if it has been tripped all along [s].

    Raises:
        ValueError: if a time is out of its range, or the ends of a range are the wrong way round.
    """

    def __init__(
        self,
        ranges: Mapping[str, Range],
        *,
        deadline: float = math.inf,
        hold: float = 0.0,
        patience: float = math.inf,
    ):
        if not deadline > 0.0:
            raise ValueError(f"deadline={deadline} s must be positive; infinity waits for ever.")
        for argument, value in (("hold", hold), ("patience", patience)):
            if not value >= 0.0:
                raise ValueError(f"{argument}={value} s must be a number that is not negative; infinity is one.")
        self._ranges = {
            entry: tuple(torch.as_tensor(end, dtype=torch.float64) for end in ends) for entry, ends in ranges.items()
        }
        for entry, (low, high) in self._ranges.items():
            if not (low < high).all():
                raise ValueError(f"range of {entry!r} is {low.tolist()} to {high.tolist()}; low must be below high.")
        self.deadline, self.hold, self.patience = deadline, hold, patience
        self.begin()

    def begin(self) -> None:
        """A new episode: nothing has been seen."""
        self._since, self._until = math.inf, -math.inf

    def faults(self, entries: Mapping[str, Tensor], elapsed: float) -> dict[str, str]:
        """What is wrong with the entries of an observation, by kind; ``elapsed`` is the time it took to come [s]."""
        found = {}
        broken = [name for name, value in entries.items() if not value.isfinite().all()]
        if broken:
            found["not finite"] = ", ".join(broken)
        outside = [name for name in self._ranges if not self._inside(name, entries[name])]
        if outside:
            found["out of range"] = ", ".join(outside)
        if elapsed > self.deadline:
            found["late"] = f"{elapsed:.6g} s, deadline {self.deadline:g} s"
        return found

    def note(self, t: float, faulty: bool) -> None:
        """An observation at the time t [s] of the control intervals."""
        if faulty:
            self._since = min(self._since, t)
            # Without a hold time it is tripped for the interval that begins now.
            self._until = t + max(self.hold, 2.0 * ROUNDING)
        elif not self.tripped(t):
            self._since = math.inf

    def tripped(self, t: float) -> bool:
        """Whether the fallback acts in the interval that begins at t [s]."""
        return t < self._until - ROUNDING

    def exhausted(self, t: float) -> bool:
        """Whether it has been tripped for as long as its patience, at t [s]."""
        return self.tripped(t) and t - self._since >= self.patience - ROUNDING

    def _inside(self, name: str, value: Tensor) -> bool:
        low, high = (end.to(value) for end in self._ranges[name])
        # What is not finite is a fault of its own.
        return bool(((value >= low) & (value <= high) | ~value.isfinite()).all())
