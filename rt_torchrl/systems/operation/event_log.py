"""The log of an operation's events: who acted when, and what was learned from which windows."""

import json
import os
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
