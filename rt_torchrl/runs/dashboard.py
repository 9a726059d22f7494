"""What a training shows while it runs: the TensorBoard dashboard and the progress bar."""

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from threading import Timer, current_thread
from typing import Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from rt_torchrl.runs.settings import flat
from rt_torchrl.runs.table import progress
from rt_torchrl.systems.operation import FIRST

GROUPS = {
    "cost": ("real_cost", "start_cost", "J_a_", "ended_after"),
    "twin": ("J_p", "paired_difference", "alarm", "closure_"),
}
"""Groups of curves, with what the names of their entries in ``metrics.json`` begin with; others are of the steps."""


class Dashboard:
    """A dashboard, which writes TensorBoard events.

    Args:
        folder: folder of the event file.
    """

    def __init__(self, folder: Path):
        self._writer = SummaryWriter(str(folder))

    def results(self, summary: Mapping[str, Any], table: str) -> None:
        """Write what the run has come to: the final costs, and the table as the terminal shows it.

        Args:
            summary: entry ``summary`` in ``metrics.json``.
            table: table of results.
        """
        judged = {key: summary[key] for key in ("unseen", "real_unseen", "cost_of_learning") if key in summary}
        for name, value in flat(judged).items():
            if name.endswith((".mean", ".sum", ".largest")) and value is not None:
                self._writer.add_scalar(f"final/{name}", value, 0)
        # TensorBoard shows Markdown, in which indented lines are code.
        self._writer.add_text("results", "\n".join("    " + line for line in table.splitlines()), 0)

    def episode(self, record: Mapping[str, Any]) -> None:
        """Write the scalars and the words of an episode, an entry in ``metrics.json``."""
        for tag, value in scalars_of(record).items():
            self._writer.add_scalar(tag, value, record["episode"])
        for tag, key in (("alarm", "warning"), ("believed", "believed")):
            if record.get(key):
                self._writer.add_text(tag, str(record[key]), record["episode"])

    def images(self, images: Mapping[str, np.ndarray], step: int) -> None:
        """Write the figures of an episode, whose number is ``step``, as pixels (height, width, 3) of ``uint8``."""
        for name, image in images.items():
            self._writer.add_image(name, image, step, dataformats="HWC")

    def close(self) -> None:
        self._writer.close()


def scalars_of(record: Mapping[str, Any]) -> dict[str, float]:
    """The scalars of an episode by tag: a group and the name in ``metrics.json``, which may have a group of its own."""
    scalars = {}
    for name, value in record.items():
        if isinstance(value, float):
            group = next((group for group, begins in GROUPS.items() if name.startswith(begins)), "steps")
            scalars[name if "/" in name else f"{group}/{name}"] = value
    scalars["switch/live is model-based"] = float(record["live"] == "model_based")
    scalars |= {f"switch/{event}": float(record.get("event") == event) for event in ("swap", "clone")}
    scalars |= {f"closure/{name}": w for name, w in (record["closure"] or {}).items() if isinstance(w, float)}
    return scalars | {f"seconds/{name}": seconds for name, seconds in record["seconds"].items()}


WORDS = {
    "start": "learning from what is known",
    "fit": "fitting the twin to what is known",
    "imitation": "imitating the controller",
    "interact": "real episode",
    "learn": "model-free update",
    "inputs": "fitting the input",
    "assimilate": "assimilating",
    "plan": "planning",
    "switch": "comparing policies",
}
"""Words in which the bar shows each step of the algorithm."""


QUIET, LONG = 10.0, 60.0
"""Times for which a log says nothing before it names the step under way, and names it again [s]."""


class Progress:
    """A bar over the real episodes, with the costs of the last one and the present step; lines where no terminal is.

    Args:
        total: number of real episodes of the training.
        done: number of episodes that were done before.
    """

    def __init__(self, total: int, done: int = 0):
        self._bar = tqdm(total=total, initial=done, unit="episode", dynamic_ncols=True, disable=None)
        self._total, self._line_at = total, -QUIET
        self._costs, self._doing, self._alarm = "", "starting", False
        self._later: Timer | None = None

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *raised: object) -> None:
        self._cancel()
        self._doing = ""
        self._show()
        self._bar.close()

    def doing(self, what: str) -> None:
        """Show what begins now: the name of a step of the algorithm, or any other words."""
        self._cancel()
        self._doing, now = WORDS.get(what, what), time.monotonic()
        self._show()
        quiet = now - self._line_at > QUIET
        if quiet:
            self._log(self._doing)
        self._name_after(LONG if quiet else QUIET, self._doing, now)

    def _name_after(self, seconds: float, step: str, since: float) -> None:
        """Name the step in the log where it lasts that long, and again while it lasts."""
        self._later = Timer(seconds, self._name, (step, since))
        self._later.daemon = True
        self._later.start()

    def _name(self, step: str, since: float) -> None:
        lasts = time.monotonic() - since
        self._log(f"{step}, for {lasts:.0f} s" if lasts >= LONG else step)
        if self._later is current_thread():  # nothing else has begun meanwhile
            self._name_after(LONG, step, since)

    def _cancel(self) -> None:
        if self._later is not None:
            self._later.cancel()
        self._later = None

    def episode(self, record: dict[str, Any]) -> None:
        """Count an episode and show its costs.

        A line says when the twin's predictions begin or cease to be wrong, and why no policy may act.
        """
        self._cancel()
        self._costs = progress(record)
        alarm = bool(record.get("alarm", self._alarm))
        if alarm != self._alarm:
            usual = f"the twin's predictions {'are wrong' if alarm else 'hold again'}"
            message = record.get("warning", usual)
            self.write(f"episode {record['episode']}: {message}")
        self._alarm = alarm
        if record["live"] == FIRST and "reason" in record:
            self.write(f"episode {record['episode']}: {record['reason']}")
        self._bar.update()
        self._show()
        self._log(f"episode {record['episode']}/{self._total}: {self._costs}")

    def write(self, line: str) -> None:
        """Write a line above the bar."""
        self._bar.write(line)

    def _log(self, line: str) -> None:
        """Write a line where the bar is not shown: into a file or a pipe."""
        if self._bar.disable:
            print(line, file=sys.stderr, flush=True)
            self._line_at = time.monotonic()

    def _show(self) -> None:
        self._bar.set_postfix_str("; ".join(part for part in (self._costs, self._doing) if part))
