"""Files of tensors in plain containers, which run no code when they are read, and whose damage is noticed."""

import errno
import hashlib
import io
import os
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rt_torchrl.atomic_file import write_atomically

SEAL = b"sha256:"
"""Beginning of the comment of an archive that holds the checksum of all before it."""


class DamagedFileError(ValueError):
    """A file that is not what a run has written: damaged, foreign, or such that loading it would run code."""


def save_tensors(path: Path, content: Mapping[str, Any]) -> None:
    """Write tensors, numbers and strings in dicts, lists and tuples; ``torch.load`` can read the file too.

    The tensors of the file are on the CPU, so that a machine without the device of the run reads it.

    Raises:
        ValueError: if ``content`` holds anything else; it names the place.
        OSError: if the file cannot be written, see :func:`write_atomically`.
    """
    buffer = io.BytesIO()
    torch.save(plain(content), buffer)
    write_atomically(path, _sealed(buffer.getvalue()))


def load_tensors(path: Path) -> dict[str, Any]:
    """The content that :func:`save_tensors` wrote, on the CPU.

    The checksum of the whole file (SHA-256) is compared first, and those of its parts (CRC-32), which files of earlier
    versions have alone.

    Raises:
        DamagedFileError: if the file is damaged, or holds any object that is not a tensor or a plain container; such an
            object is not built.
        OSError: if the file cannot be read, or memory is short, which says nothing of what it holds.
    """
    try:
        return _loaded(path)
    except (OSError, MemoryError) as error:
        number = errno.ENOMEM if isinstance(error, MemoryError) else error.errno
        reason = os.strerror(number) if number else str(error)
        raise OSError(number, f"{reason}; the file is not read and not changed, try again", str(path)) from error


def _loaded(path: Path) -> dict[str, Any]:
    file = path.read_bytes()
    try:
        sound = _verified(file)
    except MemoryError:
        raise
    # The kind of error depends on the byte that is wrong, and all of them come from the content of the file.
    except Exception as error:
        raise DamagedFileError(f"{path} is damaged, or no file of a run: {error}") from error
    try:
        content = torch.load(sound, weights_only=True, map_location="cpu")
    except MemoryError:
        raise
    except pickle.UnpicklingError as error:
        raise DamagedFileError(
            f"{path} is not loaded: it is of another version, or it would run code, because it holds more than tensors "
            f"in plain containers. {first_line(error)}"
        ) from error
    except Exception as error:  # of as many kinds
        if "allocate memory" in str(error):  # torch has no class of its own for it on the CPU
            raise MemoryError from error
        raise DamagedFileError(f"{path} is damaged, or no file of a run: {first_line(error)}") from error
    if not isinstance(content, dict):
        raise DamagedFileError(f"{path} is no file of a run: it holds a {type(content).__name__}.")
    return content


def _sealed(archive: bytes) -> bytes:
    """The bytes of a zip archive without a comment, with a comment that holds their SHA-256."""
    seal = SEAL + hashlib.sha256(archive).hexdigest().encode()
    return archive[:-2] + len(seal).to_bytes(2, "little") + seal


def _verified(file: bytes) -> io.BytesIO:
    """The archive of a file, packed anew from parts whose checksums are right.

    Torch reads fields of an archive that Python does not, such as the flag that makes a part a folder, and gives
    memory that nobody has written for it. It gets an archive in which these fields are Python's own.

    Raises:
        zipfile.BadZipFile: if a checksum is wrong, or parts would take more memory than the file has bytes; a run
            compresses nothing.
    """
    length = len(SEAL) + 64
    end = file[-length:]
    if end.startswith(SEAL):
        archive = file[: -length - 2] + b"\0\0"
        if hashlib.sha256(archive).hexdigest().encode() != end[len(SEAL) :]:
            raise zipfile.BadZipFile("it does not have the checksum that it was written with")
    elif file[-2:] != b"\0\0":  # the length of the comment, with which an archive without one ends
        raise zipfile.BadZipFile("its end is not that of a file of a run")
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(file)) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as new:
        parts = old.infolist()
        stored = all(part.compress_type == zipfile.ZIP_STORED for part in parts)
        if not stored or sum(part.file_size for part in parts) > len(file):
            raise zipfile.BadZipFile(f"its parts are larger than its {len(file)} bytes")
        if len({part.filename for part in parts}) < len(parts):
            raise zipfile.BadZipFile("two of its parts have the same name")
        for part in parts:
            new.writestr(part.filename, old.read(part))  # which compares the checksum of the part
    packed.seek(0)
    return packed


def first_line(error: Exception) -> str:
    """First line of an error's message, without the advice that torch adds after it."""
    return f"({(str(error).splitlines() or [type(error).__name__])[0]})"


def plain(value: Any, place: str = "") -> Any:
    """The value with only Python's own containers and numbers, and with plain tensors on the CPU.

    Raises:
        ValueError: if it holds anything but tensors, numbers and strings; it names the place.
    """
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().as_subclass(torch.Tensor)
    if isinstance(value, np.generic | float | int | str):
        return plain(value.item() if isinstance(value, np.generic) else _base(value), place)
    if isinstance(value, Mapping):
        return {key: plain(entry, f"{place}[{key!r}]") for key, entry in value.items()}
    if type(value) in (list, tuple, torch.Size):
        entries = [plain(entry, f"{place}[{k}]") for k, entry in enumerate(value)]
        return entries if isinstance(value, list) else tuple(entries)
    raise ValueError(
        f"{place or 'content'} of what is to be saved is a {type(value).__name__}; a state_dict may hold tensors, "
        "numbers and strings, in dicts, lists and tuples."
    )


def _base(value: float | str) -> float | str:
    """A number or string of a derived class as one of Python's own classes."""
    return next(kind(value) for kind in (float, int, str) if isinstance(value, kind))
