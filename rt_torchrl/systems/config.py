"""Options of safety layers, of operating limits, and of an operation that goes on while the algorithm learns."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rt_torchrl.options import array_of, check_options

Range = tuple[float | Sequence[float], float | Sequence[float]]
Count = int | Sequence[int]


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
        ValueError: if an option is not a number of its type, or is out of its range.
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
        if not self.deadline > 0.0:
            raise ValueError(f"deadline={self.deadline} s must be positive; infinity waits for ever.")
        for argument, value in (("hold", self.hold), ("patience", self.patience)):
            if not value >= 0.0:
                raise ValueError(f"{argument}={value} s must be a number that is not negative; infinity is one.")
        if self.clock_tolerance is not None and not self.clock_tolerance > 0.0:
            raise ValueError(f"clock_tolerance={self.clock_tolerance} s must be positive and finite.")
        for argument, ranges in (("range", self.ranges), ("limit", self.limits)):
            for entry, ends in ranges.items():
                _require_order(f"{argument} of {entry!r}", *ends)
        for entry, count in self.frozen.items():
            counts = array_of("frozen", count)
            if not ((counts >= 2.0) | (counts == 0.0)).all():
                raise ValueError(
                    f"frozen={counts.tolist()} readings of {entry!r} must be at least 2, a reading and its repetition; "
                    "0 does not watch a component."
                )


def _require_order(what: str, least: float | Sequence[float], greatest: float | Sequence[float]) -> None:
    low, high = array_of(what, least), array_of(what, greatest)
    if not (low < high).all():
        raise ValueError(f"{what} is {low.tolist()} to {high.tolist()}; low must be below high.")


@dataclass(frozen=True, kw_only=True)
class OperatingLimitsConfig:
    """Operating limits; a safety layer holds those of actions and rates, and its fallback acts beyond those of states.

    Args:
        states: least and greatest value of states, by name, in their units.
        actions: least and greatest value of actions, by name, in their units.
        rates: greatest rate of change of actions, by name [unit/s].
        tolerated: greatest share of the control intervals of virtual episodes in which a policy may be predicted to
            leave the limits; beyond it the policy does not act.

    Raises:
        ValueError: if a number is out of its range.
    """

    states: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    actions: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rates: Mapping[str, float] = field(default_factory=dict)
    tolerated: float = 0.0

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("states", "actions"):
            for name, (low, high) in getattr(self, argument).items():
                if not low < high:
                    raise ValueError(f"limits.{argument} {name}={low} to {high} must have its least value first.")
        for name, rate in self.rates.items():
            if not rate > 0.0:
                raise ValueError(f"limits.rates {name}={rate} must be positive.")
        if not 0.0 <= self.tolerated <= 1.0:
            raise ValueError(f"limits.tolerated={self.tolerated} must lie in [0, 1], a share of control intervals.")

    def __bool__(self) -> bool:
        """Whether there is any limit."""
        return bool(self.states or self.actions or self.rates)


@dataclass(frozen=True, kw_only=True)
class OperationConfig:
    """Options of an operation that goes on while the algorithm learns, with ``asynchronous``.

    Args:
        clock: simulated: one process, in which learning takes the time ``learning`` of operation, so that a run repeats
            to the bit; for systems in simulation. wall: the system operates in a process of its own, at the pace of the
            wall clock.
        learning: time that learning from one window takes on the simulated clock, as a share of a window. With 0 each
            window begins with what was learned from the one before, as in a run that is not asynchronous.
        speed: pace of a simulation on the wall clock, in seconds of the plant for each second; real systems keep their
            own time.
        handover: number of control intervals in which the difference between a policy and the one before it fades, if
            it is as wide as the range of the action; the actuators' own rate limits it too.
        continuous: whether only the first window begins with a reset of the system; an episode is then a window of
            operation.

    Raises:
        ValueError: if an option is out of its range, or is none of its choices.
    """

    clock: Literal["simulated", "wall"] = "simulated"
    learning: float = 0.5
    speed: float = 1.0
    handover: int = 20
    continuous: bool = False

    def __post_init__(self) -> None:
        check_options(self)
        if not self.learning >= 0.0:
            raise ValueError(f"learning={self.learning} windows must not be negative; 0 learns in no time.")
        if not self.speed > 0.0:
            raise ValueError(f"speed={self.speed} must be positive, in seconds of the plant for each second.")
        if self.handover < 1:
            raise ValueError(f"handover={self.handover} control intervals must be at least 1.")
