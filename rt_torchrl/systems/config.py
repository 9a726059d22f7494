"""Options of safety layers, of operating limits, and of an operation that goes on while the algorithm learns."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Annotated

from pydantic import Field, SkipValidation

from rt_torchrl.options import File, Limit, Positive, Unbounded, array_of, configuration

Range = Annotated[tuple[float | Sequence[float], float | Sequence[float]], SkipValidation]
"""Least and greatest values, which are checked in words of their own."""
Duration = Annotated[float, Field(ge=0, allow_inf_nan=True)]
Count = Annotated[int | Sequence[int], SkipValidation]


@configuration
class SafetyConfig:
    """Limits of a safety layer on actions and observations.

    Args:
        interval: control interval of the system [s].
        low: least value of each action, where it is to be above the system's own.
        high: greatest value of each action, where it is to be below the system's own.
        rates: greatest rate of change of each action [unit/s]; infinity does not limit it. That of the first action of
            an episode is free, unless a :class:`ConnectedPlant` with an entry ``applied`` says what the machine has
            applied last.
        ranges: admissible range (low, high) of entries of the observation, by name; each end is one number for all
            components or one number for each component.
        limits: range (low, high) of entries of the observation in which the system is to stay, as ``ranges``. Beyond it
            the fallback acts, and the reading is learned from.
        frozen: entries of the observation whose components always move, by name, each with the number of equal readings
            in a row that count as a frozen sensor: one number for all components, or one for each, where 0 does not
            watch a component.
        deadline: longest wall-clock time from an action to the observation of its effect [s].
        hold: time without a fault after which the policy acts again [s]; with infinity it does not act again in the
            same episode.
        log: file to which every event is appended, as one JSON object per line.

    Raises:
        ValueError: if an option is not a number of its type, or is out of its range.
    """

    interval: Positive
    low: tuple[Unbounded, ...] | None = None
    high: tuple[Unbounded, ...] | None = None
    rates: tuple[Limit, ...] | None = None
    ranges: Mapping[str, Range] = field(default_factory=dict)
    limits: Mapping[str, Range] = field(default_factory=dict)
    frozen: Mapping[str, Count] = field(default_factory=dict)
    deadline: Limit = math.inf
    hold: Duration = 0.0
    log: File | None = None

    def __post_init__(self) -> None:
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


@configuration
class OperatingLimitsConfig:
    """Operating limits; a safety layer holds those of actions and rates, and its fallback acts beyond those of states.

    Args:
        states: least and greatest value of states, by name, in their units.
        actions: least and greatest value of actions, by name, in their units.
        rates: greatest rate of change of actions, by name [unit/s].

    Raises:
        ValueError: if a number is out of its range.
    """

    states: Mapping[str, tuple[Unbounded, Unbounded]] = field(default_factory=dict)
    actions: Mapping[str, tuple[Unbounded, Unbounded]] = field(default_factory=dict)
    rates: Mapping[str, Limit] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for argument in ("states", "actions"):
            for name, ends in getattr(self, argument).items():
                _require_order(f"limits.{argument} {name}", *ends)

    def __bool__(self) -> bool:
        """Whether there is any limit."""
        return bool(self.states or self.actions or self.rates)


@configuration
class OperationConfig:
    """Options of an operation that goes on while the algorithm learns, with ``asynchronous``.

    Args:
        speed: pace of a simulation on the wall clock, in seconds of the plant for each second; real systems keep their
            own time.
        continuous: whether only the first window begins with a reset of the system, which must be a
            :class:`RealSystem`; an episode is then a window of operation.

    Raises:
        ValueError: if an option is out of its range.
    """

    speed: Positive = 1.0
    continuous: bool = False
