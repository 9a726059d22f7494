"""The pace of a control loop: when its next interval is due, and how late it begins."""

import time
from collections.abc import Callable


class Pace:
    """Waits for the beginning of each control interval.

    The attribute ``late`` is by how much the last interval began after it was due [s], and ``missed`` the number of
    intervals that began a whole period late or later. These are not made up for: the pace goes on from the moment when
    the late one began.

    Args:
        period: time from one beginning to the next [s].
        clock: wall clock [s].
        sleep: function that waits for some time [s].

    Raises:
        ValueError: if the period is not positive.
    """

    def __init__(
        self,
        period: float,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        if not period > 0.0:
            raise ValueError(f"period={period} s of a control loop must be positive.")
        self.period, self._clock, self._sleep = period, clock, sleep
        self.late, self.missed = 0.0, 0
        self._due: float | None = None

    def begin(self) -> None:
        """Begin anew: the next interval is due at once."""
        self._due = None

    def shift(self, seconds: float | None) -> None:
        """Move all intervals to come by some time [s]; with None the present moment is when this one was due."""
        now = self._clock()
        self._due = now if seconds is None or self._due is None else self._due + seconds

    def wait(self) -> float:
        """Wait until the next interval is due; by how much it begins late [s]."""
        now = self._clock()
        due = now if self._due is None else self._due + self.period
        if due > now:
            self._sleep(due - now)
            now = self._clock()
        self.late = now - due
        missed = self.late >= self.period
        self.missed += missed
        self._due = now if missed else due
        return self.late
