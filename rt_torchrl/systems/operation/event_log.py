"""The log of an operation's events, from which the same run repeats to the bit."""

import json
import os
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
    ``resumed``      the run goes on after a stop, with the window of this number and the versions up to this one; what
                     was taken and handed over later than that, before the stop, is lost
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
                file.flush()
                os.fsync(file.fileno())  # a checkpoint that outlives a power cut needs its events

    def resume(self, *, window: int, version: int) -> None:
        """Note that a run goes on from a checkpoint, and remove a line that a kill has cut off.

        Args:
            window: number of windows that had been taken.
            version: number of the latest order.
        """
        if self.path is not None and self.path.is_file():
            whole = self.path.read_bytes()
            os.truncate(self.path, whole.rfind(b"\n") + 1)
        self.note("resumed", window=window, version=version)


def read_events(path: Path) -> list[dict[str, Any]]:
    """The events in a file.

    Raises:
        ValueError: if the file cannot be read, a line is no event, or events are missing.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"replay={path} cannot be read: {error}") from error
    events = kept([event_of(path, number, line) for number, line in enumerate(lines, 1)])
    _require_whole(path, events)
    return events


def _require_whole(path: Path, events: Sequence[dict[str, Any]]) -> None:
    """Refuse a log without all events of its run.

    Raises:
        ValueError: if a window or a version is missing.
    """
    for event, name in (("taken", "window"), ("handed over", "version")):
        numbers = [one[name] for one in events if one["event"] == event]
        wrong = [(number, due) for due, number in enumerate(numbers) if number != due]
        if wrong:
            number, due = wrong[0]
            raise ValueError(
                f"replay={path} lacks events: {name} {number} stands where {name} {due} should. Only a log with all "
                "events of its run can be replayed; repeat a run with the options in its config.json instead."
            )
    handed = sum(one["event"] == "handed over" for one in events)
    flown = {version for one in events for _, version in one.get("flown", ())}
    if flown - set(range(handed)):
        raise ValueError(
            f"replay={path} lacks events: version {max(flown)} acted, and {handed} versions were handed over. Only a "
            "log with all events of its run can be replayed."
        )


def kept(events: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The events of a run without those that were lost when it was stopped and resumed."""
    found: list[dict[str, Any]] = []
    for event in events:
        if event["event"] == "resumed":
            window, version = event["window"], event["version"]
            least = {"taken": window, "handed over": version + 1, "resumed": window + 1}
            found = [one for one in found if _number(one) < least[one["event"]]]
        found.append(event)
    return found


def _number(event: dict[str, Any]) -> int:
    """Number of the window or, of an order, of the version."""
    return int(event["version" if event["event"] == "handed over" else "window"])


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
        if found["event"] == "resumed":
            return {"event": "resumed", "window": int(found["window"]), "version": int(found["version"])}
        raise ValueError(f"event {found['event']!r} is unknown")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
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
        elif event["event"] == "handed over":
            found.append([])
    return found


def stops(events: Sequence[dict[str, Any]]) -> set[int]:
    """The windows with which a run has gone on after a stop."""
    return {event["window"] for event in events if event["event"] == "resumed"}
