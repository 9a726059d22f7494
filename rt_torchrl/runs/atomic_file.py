"""A file that is written whole or not at all."""

import contextlib
import json
import math
import os
import secrets
from pathlib import Path
from typing import Any

PARTIAL = ".partial"


def write_atomically(path: Path, content: bytes) -> None:
    """Put ``content`` in the place of a file; whatever happens, the file is the old one or the new one.

    Raises:
        OSError: if it cannot be written, such as on a full disk; the old file is left as it was.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}{PARTIAL}")
    try:
        with partial.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            reason = error.strerror or str(error)
            raise OSError(error.errno, f"{reason}; what was there before is intact, make room", str(path)) from error
        raise


def remove_partials(folder: Path) -> None:
    """Remove what writers that were killed have left in a folder where nobody else writes."""
    for partial in folder.glob(f".*{PARTIAL}"):
        partial.unlink(missing_ok=True)


def write_json(path: Path, content: Any) -> None:
    """Write JSON as its standard has it, which knows no NaN and no infinity; see :func:`finite`.

    Raises:
        ValueError: if a number is not finite.
        OSError: see :func:`write_atomically`.
    """
    write_atomically(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def finite(content: Any) -> Any:
    """The same with None for every number that is not finite."""
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    if isinstance(content, dict):
        return {key: finite(value) for key, value in content.items()}
    return [finite(value) for value in content] if isinstance(content, list | tuple) else content
