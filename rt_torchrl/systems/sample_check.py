"""The check of the order of readings: does the system's clock go on, and does every sensor still move?"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from rt_torchrl.options import array_of, require_number

Count = int | Sequence[int]
SHARE = 0.5
"""Share of an interval by which the system's clock may miss it, unless a tolerance is given."""


class SampleCheck:
    """Compares each reading with the one before.

    A sample that comes twice, or is left out, shows in the system's clock. The clock may also jump and go on from
    there; then one interval is wrong. A sensor that is frozen repeats its value.

    The attribute ``stale`` holds the number of readings before the present one that are wrong too, because a sensor was
    frozen before that could be known.

    Args:
        clock: entry that holds the system's clock [s]; None if it reports none.
        interval: control interval of the system [s].
        tolerance: greatest difference between the clock's step and the interval [s]; None for half an interval.
        frozen: entries whose components always move, each with the number of equal readings in a row that count as a
            frozen sensor: one number for all components, or one for each, where 0 does not watch a component.

    Raises:
        ValueError: if a number is out of its range.
    """

    def __init__(
        self,
        *,
        clock: str | None = None,
        interval: float = math.inf,
        tolerance: float | None = None,
        frozen: Mapping[str, Count] | None = None,
    ):
        if tolerance is not None:
            require_number("clock_tolerance", tolerance)
        if tolerance is not None and not 0.0 < tolerance < math.inf:
            raise ValueError(f"clock_tolerance={tolerance} s must be positive and finite.")
        self._frozen = {entry: torch.as_tensor(array_of("frozen", count)) for entry, count in (frozen or {}).items()}
        for entry, counts in self._frozen.items():
            if not ((counts >= 2.0) | (counts == 0.0)).all():
                raise ValueError(
                    f"frozen={counts.tolist()} readings of {entry!r} must be at least 2, a reading and its repetition; "
                    "0 does not watch a component."
                )
        self._clock, self._interval = clock, interval
        self._tolerance = SHARE * interval if tolerance is None else tolerance
        self.begin()

    def begin(self) -> None:
        """Begin a new episode, of which nothing has been read."""
        self._sound = self._last = -math.inf
        self._since, self.stale = 0, 0
        self._values: dict[str, tuple[Tensor, Tensor]] = {}

    def faults(self, entries: Mapping[str, Tensor]) -> dict[str, str]:
        """Faults of the next reading by kind, each with a detail; an entry that is missing is not judged."""
        found, self.stale = {}, 0
        if self._clock is not None and (said := self._clock_fault(entries.get(self._clock))):
            found["clock"] = said
        for entry, limit in self._frozen.items():
            count = self._equal(entry, entries[entry], limit) if entry in entries else 0
            if count:
                found["frozen"] = f"{entry}, {count} equal readings"
                self.stale = max(self.stale, count - 2)
        return found

    def _clock_fault(self, value: Tensor | None) -> str | None:
        """What is wrong with the clock; a step is right if it fits the last sound reading or the last one of all."""
        self._since += 1
        now = math.nan if value is None else float(value.flatten()[0])
        if not math.isfinite(now):
            self._last = -math.inf
            return None
        last, self._last = self._last, now
        steps = (now - self._sound - self._since * self._interval, now - last - self._interval)
        if math.isfinite(self._sound) and not any(abs(step) <= self._tolerance for step in steps):
            return f"{now - max(last, self._sound):.6g} s after the last reading, interval {self._interval:g} s"
        self._sound, self._since = now, 0
        return None

    def _equal(self, entry: str, value: Tensor, limit: Tensor) -> int:
        """Number of equal readings in a row, with this one, of the component frozen for longest; 0 if none is."""
        last, counts = self._values.get(entry, (torch.full_like(value, torch.nan), torch.ones_like(value)))
        counts = torch.where(value == last, counts + 1, torch.ones_like(counts))
        self._values[entry] = value.clone(), counts
        limit = limit.to(counts)
        return int(torch.where((limit > 0.0) & (counts >= limit), counts, 0.0).max())
