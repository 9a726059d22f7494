"""The JSON file of results that a recipe writes at its end, and the folder that holds it."""

import dataclasses
import os
import time
from pathlib import Path
from typing import Any

from rt_torchrl.atomic_file import finite, write_json


def make_folder(option: str, folder: Path) -> None:
    """Make the folder of the results, before the work whose results it is to hold.

    Args:
        option: name of the option that gives the folder, for the message.
        folder: folder; it may exist.

    Raises:
        ValueError: if the folder cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{option}={folder} cannot be made ({error.strerror}); choose another folder.") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{option}={folder} cannot be written; choose another folder.")


def new_folder(parent: Path, ending: str = "") -> Path:
    """Make a folder with the present time in its name, which no other process has made.

    Args:
        parent: folder in which it is made; it need not exist.
        ending: what its name ends with.

    Raises:
        OSError: if the folder cannot be made.
    """
    stamp, number = time.strftime("%Y%m%d-%H%M%S"), 1
    while True:
        folder = parent / f"{stamp if number == 1 else f'{stamp}-{number}'}{ending}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:  # of the same second
            number += 1
        else:
            return folder


def write_results(path: Path, content: dict[str, Any]) -> Path:
    """Write results with null for every number that is not finite, and text for paths; return the path.

    Raises:
        OSError: if the file cannot be written; its old content stays.
    """
    write_json(path, finite(_plain(content)))
    return path


def _plain(content: Any) -> Any:
    if dataclasses.is_dataclass(content) and not isinstance(content, type):
        return _plain(dataclasses.asdict(content))
    if isinstance(content, dict):
        return {key: _plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_plain(value) for value in content]
    return str(content) if isinstance(content, Path) else content
