"""What a safety layer did, interval by interval."""

import json
import math
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple


class SafetyEvent(NamedTuple):
    """One control interval in which the layer acted or saw a fault.

    ``reasons`` maps each reason to a detail. ``range`` and ``rate`` say that the action was limited, ``asked`` that the
    policy's action was not finite, and ``fallback`` that the fallback acted. ``missing``, ``not finite``, ``out of
    range``, ``frozen``, ``clock`` and ``late`` are faults of the observation at the end of the interval. ``limit`` says
    that the system has left its limits, and ``actuator`` that an actuator does not follow. ``truncated`` says that the
    layer ended the episode.
    """

    episode: int
    step: int
    time: float  # start of the interval, counted from the start of the episode [s]
    reasons: dict[str, str]
    asked: list[float]
    applied: list[float]
    at: float  # end of the interval on this machine's clock, counted from 1970 [s]

    def line(self) -> str:
        """The event as one line of JSON, with null for every number that is not finite."""
        entry = self._asdict()
        for key in ("asked", "applied"):
            entry[key] = [value if math.isfinite(value) else None for value in entry[key]]
        return json.dumps(entry)


@dataclass
class SafetyReport:
    """Events of one episode, the number of intervals in which each reason occurred, and where readings are wrong.

    ``wrong`` holds the intervals at whose end the observation is wrong, also those of which this became known later.
    """

    events: list[SafetyEvent] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    wrong: set[int] = field(default_factory=set)
