"""C files of tests, compiled with all warnings as errors and called without this library's loader."""

import ctypes
import shutil
import subprocess

import pytest

from rt_torchrl.export.c_file import COMPILERS

COMPILER = next(filter(None, map(shutil.which, COMPILERS)), None)
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler here")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror")


def library(path):
    """The library of a C file."""
    found = path.with_suffix(".so")
    subprocess.run([COMPILER, *STRICT, "-shared", "-fPIC", path, "-o", found, "-lm"], check=True)
    return ctypes.CDLL(str(found))


def printed(folder, *sources):
    """What a program of C files in a folder prints."""
    program = folder / "main"
    subprocess.run([COMPILER, *STRICT, *(folder / name for name in sources), "-o", program, "-lm"], check=True)
    return subprocess.run([program], capture_output=True, text=True, check=True).stdout
