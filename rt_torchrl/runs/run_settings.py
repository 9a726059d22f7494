"""What ``config.json`` holds: the options asked for and what ran, and how the options of two starts differ."""

import dataclasses
import importlib.metadata
import json
import platform
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from rt_torchrl.runs.atomic_file import write_atomically
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.settings import BESIDE, FILE, RAN, read_settings, settings_of

VERSIONS_OF = ("rt_torchrl", "torch", "torchrl", "tensordict")
HARMLESS = {
    *("episodes", "figures", "figures_every", "unseen_every", "untrained", "reference"),
    # These change a result by rounding alone.
    *("threads", "compiled"),
    *("log_dir", "resume", "overwrite"),
}
"""Options that a resumed run may have otherwise than it began: how long it is, what it reports, how fast it is."""
ABSENT = "nothing"


def write_settings(folder: Path, asked: RunConfig, effective: RunConfig, plant: str) -> None:
    """Write ``config.json``: the options asked for, ``plant``, and ``ran``, an entry for every start of the run.

    Raises:
        OSError: if it cannot be written.
    """
    before = read_settings(folder).get(RAN, []) if asked.resume else []
    ran = {
        "effective": as_written(effective),
        "versions": versions(),
        "command": shlex.join(sys.argv),
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }
    settings = settings_of(asked, plant) | {RAN: [*before, ran]}
    # Options may be infinite: JSON of Python's kind, so that they come back as they are.
    write_atomically(folder / FILE, (json.dumps(settings, indent=2, default=str) + "\n").encode())


def versions() -> dict[str, str | None]:
    """Of this library, of what it computes with, and of Python; None for one that is not installed as a package."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in VERSIONS_OF:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def as_written(config: RunConfig) -> dict[str, Any]:
    """The options as they are read back from JSON."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))


def require_same(folder: Path, asked: RunConfig) -> None:
    """Refuse to go on with a run under other options than its own, except for harmless ones.

    ``unseen`` is harmless too, where no episode was judged on the unseen ones so far.

    Raises:
        ValueError: naming each option that differs, with both values.
    """
    its = flat(read_settings(folder))
    asks = flat(as_written(asked))
    defaults = flat(as_written(type(asked)()))
    harmless = HARMLESS | (set() if its.get("unseen_every") else {"unseen"})
    found = []
    for name in sorted(its.keys() | asks.keys()):
        if name.split(".")[0] in harmless | set(BESIDE):
            continue
        # A run of an earlier version had what is the default of an option that is new since then.
        was, now = its.get(name, defaults.get(name, ABSENT)), asks.get(name, ABSENT)
        if was != now:
            found.append(f"{name} is {now} here and was {was} in the run")
    if found:
        raise ValueError(
            f"log_dir={folder} is to be resumed with other options than its own: {'; '.join(found)}. Give the run's "
            "own, or another folder for a new run."
        )


def flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options by their dotted names, as on the command line."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict) and value:
            found |= flat(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found
