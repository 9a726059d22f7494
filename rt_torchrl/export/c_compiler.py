"""The compiler of this machine: a C file as a library that Python can call."""

import ctypes
import math
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

Found = TypeVar("Found")
COMPILERS = ("cc", "gcc", "clang")
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror")


def compiler() -> str | None:
    """The compiler of this machine; None if it has none."""
    return next(filter(None, map(shutil.which, COMPILERS)), None)


def checked(sources: dict[str, str], what: str, compare: Callable[[ctypes.CDLL], Found]) -> Found | None:
    """Compile a C file and compare it with what it was made of.

    Args:
        sources: the texts of the header and the C file, by name; the C file is the last.
        what: name of the exported thing, for messages.
        compare: comparison of the loaded library, which raises ValueError on a difference.

    Returns:
        The result of the comparison; None without a compiler, of which a warning tells.

    Raises:
        ValueError: if the file does not compile without a warning, or the comparison fails.
    """
    found = compiler()
    if found is None:
        warnings.warn(
            f"{what} was not checked: there is no C compiler here ({', '.join(COMPILERS)}). Compare it "
            "where you compile it.",
            stacklevel=4,
        )
        return None
    with tempfile.TemporaryDirectory() as folder:
        for name, text in sources.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        return compare(ctypes.CDLL(str(compile_c(found, Path(folder) / list(sources)[-1], *STRICT))))


def compile_c(compiler: str, file: Path, *options: str) -> Path:
    """Compile a C file to a shared library beside it.

    Raises:
        ValueError: if the compiler refuses the file.
    """
    library = file.with_suffix(".so")
    command = [compiler, "-std=c99", "-O1", "-shared", "-fPIC", *options, str(file), "-o", str(library), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"the C file could not be compiled by `{' '.join(command)}`: {done.stderr.strip()}")
    return library


def c_array(numbers: Sequence[float]) -> ctypes.Array[ctypes.c_double]:
    """An array of doubles for a call."""
    return (ctypes.c_double * max(1, len(numbers)))(*numbers)


def called(function: Any, arguments: Sequence[Any], count: int) -> Tensor:
    """The ``count`` numbers that a function writes into the array after its arguments."""
    out = c_array([math.nan] * count)
    function.restype = None
    function(*arguments, out)
    return torch.tensor(list(out)[:count], dtype=torch.float64)
