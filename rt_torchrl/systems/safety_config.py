"""The limits of a safety layer."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rt_torchrl.options import check_options
from rt_torchrl.systems.sample_check import Count, SampleCheck
from rt_torchrl.systems.watchdog import Range, Watchdog


@dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    """Limits of a safety layer on actions and observations.

    Args:
        interval: control interval of the system [s].
        low: least value of each action, where it is to be above the system's own.
        high: greatest value of each action, where it is to be below the system's own.
        rates: greatest rate of change of each action [unit/s]; infinity does not limit it.
        rest: action, within its range, from which the rate limits the first action of an episode; with None the rate
            of the first action is free. A :class:`ConnectedPlant` with an entry ``applied`` says what the machine has
            applied last, and the rate limits the first action from there.
        ranges: admissible range (low, high) of entries of the observation, by name; each end is one number for all
            components or one number for each component.
        limits: range (low, high) of entries of the observation in which the system is to stay, as ``ranges``. Beyond it
            the fallback acts, and the reading is learned from.
        clock: entry of the observation that holds the system's clock [s], where it has one. A sample that comes twice
            or is left out, and a clock that jumps, show in it.
        clock_tolerance: greatest difference between the clock's step and the interval [s]; None for half an interval.
        frozen: entries of the observation whose components always move, by name, each with the number of equal readings
            in a row that count as a frozen sensor: one number for all components, or one for each, where 0 does not
            watch a component.
        following: greatest difference between the action sent and the one that the system reports as ``applied``, for
            each action; beyond it an event says that the actuator does not follow. None does not compare them.
        deadline: longest wall-clock time from an action to the observation of its effect [s].
        hold: time without a fault after which the policy acts again [s]; with infinity it does not act again in the
            same episode.
        patience: time of uninterrupted fallback after which the episode is truncated [s].
        log: file to which every event is appended, as one JSON object per line.

    Raises:
        ValueError: if an option is not a number of its type, or the interval is not positive and finite.
    """

    interval: float
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None
    rates: tuple[float, ...] | None = None
    rest: tuple[float, ...] | None = None
    ranges: Mapping[str, Range] = field(default_factory=dict)
    limits: Mapping[str, Range] = field(default_factory=dict)
    clock: str | None = None
    clock_tolerance: float | None = None
    frozen: Mapping[str, Count] = field(default_factory=dict)
    following: tuple[float, ...] | None = None
    deadline: float = math.inf
    hold: float = 0.0
    patience: float = math.inf
    log: Path | None = None

    def __post_init__(self) -> None:
        check_options(self, infinite=("low", "high", "rates", "following", "deadline", "hold", "patience"))
        if not self.interval > 0.0:
            raise ValueError(f"interval={self.interval} s must be positive: the system's control interval.")
        self.watchdog()  # which has ranges of its own

    def watchdog(self) -> Watchdog:
        """The watchdog of these limits."""
        return Watchdog(
            self.ranges,
            deadline=self.deadline,
            hold=self.hold,
            patience=self.patience,
            limits=self.limits,
            samples=SampleCheck(
                clock=self.clock, interval=self.interval, tolerance=self.clock_tolerance, frozen=self.frozen
            ),
        )
