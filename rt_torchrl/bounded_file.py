"""The size of a file of others, which is bounded before the file is read."""

import os
from pathlib import Path

GREATEST = 2**31
"""Greatest number of bytes of a file that is read at once."""


def require_bounded(path: str | os.PathLike[str], greatest: int = GREATEST) -> None:
    """Refuse a file that does not exist, is no ordinary file, or is too large to be what it should be.

    Args:
        path: the file.
        greatest: greatest number of bytes.

    Raises:
        ValueError: if the file is refused.
    """
    if not Path(path).is_file():
        raise ValueError(f"{path} is no file; give the path of one.")
    size = Path(path).stat().st_size
    if size > greatest:
        raise ValueError(f"{path} has {size} bytes; at most {greatest} are read. Cut it, or give another file.")
