"""The log of an operation's events, from which the same run repeats to the bit."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any


class EventLog:
    """Events of an operation, one JSON object per line.

    ===============  ==============================================================================================
    event            meaning
    ===============  ==============================================================================================
    ``taken``        the learner has taken the ``window``, whose versions are those ``flown``: [first interval, version]
    ``handed over``  the learner has handed a ``version`` over; a later window says in which interval it began to act
    ===============  ==============================================================================================

    Args:
        path: file; None keeps the events in ``events`` alone.
    """

    def __init__(self, path: Path | None = None):
        self.path = path
        self.events: list[dict[str, Any]] = []

    def note(self, event: str, **values: Any) -> None:
        """Add an event."""
        entry = {"event": event, **values}
        self.events.append(entry)
        if self.path is not None:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")


def read_events(path: Path) -> list[dict[str, Any]]:
    """The events in a file.

    Raises:
        ValueError: if the file cannot be read, or a line is no event.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"replay={path} cannot be read: {error}") from error
    return [event_of(path, number, line) for number, line in enumerate(lines, 1)]


def event_of(path: Path, number: int, line: str) -> dict[str, Any]:
    """The event in a line of a file.

    Raises:
        ValueError: if the line is no event.
    """
    try:
        found = json.loads(line)
        if found["event"] == "taken":
            taken = {"window": int(found["window"]), "flown": [(int(k), int(v)) for k, v in found["flown"]]}
            return {"event": "taken", **taken}
        if found["event"] == "handed over":
            return {"event": "handed over", "version": int(found["version"])}
        raise ValueError(f"event {found['event']!r} is unknown")
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"replay={path} line {number} is no event of an operation: {line[:80]!r} ({error})."
        ) from error


def first_intervals(events: Sequence[dict[str, Any]]) -> dict[int, int]:
    """The interval in which each version began to act, by version.

    A version that another one replaced before it acted began in the interval of that one.
    """
    found: dict[int, int] = {}
    for event in events:
        for interval, version in event.get("flown", ()):
            found.setdefault(version, interval)
    for version in range(max(found, default=0), -1, -1):
        if version not in found:
            found[version] = found[version + 1]
    return found


def counts_taken(events: Sequence[dict[str, Any]]) -> list[list[int]]:
    """The windows that the learner has taken between two orders, in lists; the first one before the first order."""
    found: list[list[int]] = [[]]
    for event in events:
        if event["event"] == "taken":
            found[-1].append(event["window"])
        else:
            found.append([])
    return found
