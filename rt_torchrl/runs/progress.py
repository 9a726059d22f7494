"""The progress bar of a training, which shows what the training does from the first second to the last."""

import sys
import threading
import time
from typing import Any

from tqdm import tqdm

from rt_torchrl.runs.results_table import progress
from rt_torchrl.trajectories.engines.parallel import watched_compilation

WORDS = {
    "start": "learning from what is known",
    "interact": "real episode",
    "learn": "model-free update",
    "inputs": "fitting the input",
    "assimilate": "assimilating",
    "plan": "planning",
    "switch": "comparing policies",
}
"""Words in which the bar shows each step of the algorithm."""
ON_TERMINAL, IN_FILE = 0.5, 30.0
"""Time between two refreshes [s]; it is longer in a file, which keeps every one of them."""


class Progress:
    """A bar over the real episodes that also moves during a step.

    It shows the costs of the last episode, the present step with its time, and whether the compiler is at work. The
    first graphs take a minute to compile, in which nothing else would move.

    Args:
        total: number of real episodes of the training.
        done: number of episodes that were done before.
    """

    def __init__(self, total: int, done: int = 0):
        self._bar = tqdm(total=total, initial=done, unit="episode", dynamic_ncols=True)
        self._interval = ON_TERMINAL if sys.stderr.isatty() else IN_FILE
        self._costs, self._doing, self._since = "", "starting", time.perf_counter()
        self._compiling, self._alarm, self._ended = False, False, threading.Event()
        self._believed: str | None = None
        self._thread = threading.Thread(target=self._keep_moving, daemon=True)

    def __enter__(self) -> "Progress":
        self._watch = watched_compilation(self._compilation)
        self._watch.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._ended.set()
        self._thread.join()
        self._watch.__exit__(None, None, None)
        self._doing = ""
        self._show()
        self._bar.close()

    def doing(self, what: str) -> None:
        """Show what begins now: the name of a step of the algorithm, or any other words."""
        self._doing, self._since = WORDS.get(what, what), time.perf_counter()
        self._show()

    def episode(self, record: dict[str, Any]) -> None:
        """Count an episode and show its costs.

        A line says when the twin's predictions begin or cease to be wrong, and when another twin is believed.
        """
        self._costs = progress(record)
        alarm = bool(record.get("alarm", self._alarm))
        if alarm != self._alarm:
            found = record.get("warning", "the twin's predictions hold again")
            self.write(f"episode {record['episode'] + 1}: {found}")
        self._alarm = alarm
        believed = record.get("believed")
        if believed != self._believed:
            said = f"the twin with {believed!r}" if believed else "the twin alone"
            self.write(f"episode {record['episode'] + 1}: {said} is the likeliest; J_p and closure are its own")
        self._believed = believed
        self._bar.update()
        self._show()

    def write(self, line: str) -> None:
        """Write a line above the bar."""
        self._bar.write(line)

    def _compilation(self, under_way: bool) -> None:
        self._compiling = under_way

    def _keep_moving(self) -> None:
        while not self._ended.wait(self._interval):
            self._show()

    def _show(self) -> None:
        seconds = time.perf_counter() - self._since
        doing = f"{self._doing} {seconds:.0f} s{', compiling' if self._compiling else ''}" if self._doing else ""
        self._bar.set_postfix_str("; ".join(part for part in (self._costs, doing) if part))
