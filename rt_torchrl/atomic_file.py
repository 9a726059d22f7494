"""A file that is written whole or not at all."""

import contextlib
import json
import os
import secrets
import time
from pathlib import Path
from typing import Any

from pydantic_core import to_json, to_jsonable_python

PARTIAL = ".partial"


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file whole or not at all: whatever happens, it has its old content or ``content``.

    Raises:
        OSError: if the file cannot be written, such as on a full disk; its old content stays.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}{PARTIAL}")
    try:
        with partial.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise OSError(error.errno, f"{error.strerror or error}; what was there before is intact", str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
    # The names in the folder go to the disk, too, so that a power cut does not bring an old name back.
    with contextlib.suppress(OSError):  # Windows opens no folder, and some file systems flush none
        descriptor = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def remove_partials(folder: Path) -> None:
    """Remove partial files that killed processes have left; no other process may write in the folder."""
    for partial in folder.glob(f".*{PARTIAL}"):
        partial.unlink(missing_ok=True)


def write_json(path: Path, content: Any) -> Path:
    """Write standard JSON of what :func:`finite` makes of a content, and return the path.

    Raises:
        OSError: if the file cannot be written, see :func:`write_atomically`.
    """
    write_atomically(path, to_json(content, indent=2, inf_nan_mode="null") + b"\n")
    return path


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        ValueError: if the file cannot be read, is damaged, or holds something else.
    """
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged, or cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold an object.")
    return content


def finite(content: Any) -> Any:
    """The content as JSON has it: None for every number that is not finite, text for paths, objects for dataclasses."""
    return to_jsonable_python(content, inf_nan_mode="null")


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
    while True:
        folder = parent / f"{time.strftime('%Y%m%d-%H%M%S')}{ending}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:  # of this second
            time.sleep(0.1)
        else:
            return folder
