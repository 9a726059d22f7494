"""Writing ``config.json``, and the comparison of its options with those of a resumed run."""

import dataclasses
import importlib.metadata
import json
import platform
import shlex
import sys
import time
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.settings import BESIDE, FILE, RAN, read_settings, settings_of

VERSIONS_OF = ("rt_torchrl", "torch", "torchrl", "tensordict")
HARMLESS = {
    *("episodes", "patience", "figures", "figures_every", "unseen_every", "untrained", "reference", "limit_episodes"),
    *("real_unseen", "checkpoints", "loggers"),
    # These change a result by rounding alone.
    *("threads", "compiled"),
    *("config", "log_dir", "resume", "overwrite"),
}
"""Options that may differ when a run is resumed: those of its length, its reports and its speed."""
ABSENT = "nothing"


def write_settings(folder: Path, asked: RunConfig, effective: RunConfig, plant: str) -> None:
    """Write ``config.json``: the settings of the run, and ``ran`` with an entry for every start of the run.

    Args:
        folder: run folder.
        asked: options as they were asked for.
        effective: options that the run carries out.
        plant: name of the plant.

    Raises:
        OSError: if the file cannot be written.
    """
    before = read_settings(folder).get(RAN, []) if asked.resume else []
    ran = {
        "effective": as_written(effective),
        "versions": versions(),
        "command": shlex.join(sys.argv),
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }
    settings = settings_of(asked, plant) | {RAN: [*before, ran]}
    # Options may be infinite; JSON as Python writes it keeps them as they are.
    write_atomically(folder / FILE, (json.dumps(settings, indent=2, default=str) + "\n").encode())


def versions() -> dict[str, str | None]:
    """Versions of Python, this library and the libraries it computes with; None for one that is not a package."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in VERSIONS_OF:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def as_written(config: RunConfig) -> dict[str, Any]:
    """The options as JSON gives them back."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))


def require_same(folder: Path, asked: RunConfig) -> None:
    """Refuse to go on with a run under options that differ from its own, except for harmless ones.

    ``unseen`` is harmless too if the run has not judged any training episode on the unseen episodes.

    Raises:
        ValueError: if an option differs; it names each such option with both values.
    """
    judged = flat(read_settings(folder)).get("unseen_every")
    if found := differences(folder, asked, HARMLESS if judged else HARMLESS | {"unseen"}):
        raise ValueError(
            f"log_dir={folder} is to be resumed with other options than its own: {'; '.join(found)}. Give the run's "
            "own options, or another folder for a new run."
        )


def differences(folder: Path, asked: RunConfig, harmless: AbstractSet[str] = HARMLESS) -> list[str]:
    """What differs between the options of a run and those that are asked for, in words.

    Args:
        folder: run folder.
        asked: options as they are asked for.
        harmless: options that may differ.

    Raises:
        ValueError: if the folder is not a run folder, or its settings are damaged.
    """
    its = flat(read_settings(folder))
    asks = flat(as_written(asked))
    defaults = flat(as_written(type(asked)()))
    found = []
    for name in sorted(its.keys() | asks.keys()):
        if name.split(".")[0] in {*harmless, *BESIDE}:
            continue
        # A run of an earlier version had, for an option that is new since then, the value that is now its default.
        was, now = its.get(name, defaults.get(name, ABSENT)), asks.get(name, ABSENT)
        if was != now:
            found.append(f"{name} is {now} here and was {was} in the run")
    return found


def flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options by their dotted names, as the command line has them."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict) and value:
            found |= flat(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found
