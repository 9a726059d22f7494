"""Mathematical functions for lanes: from the C library's vector functions where it has them, lane by lane elsewhere."""

import ctypes
import ctypes.util
import platform
import sys
from functools import cache
from typing import NamedTuple

import llvmlite.binding as llvm

from rt_torchrl.programs.operations import FUNCTIONS, ROUNDED


class Lanes(NamedTuple):
    """The lanes of a processor.

    Args:
        number: number of doubles that are computed at once.
        variant: letter of the C library's vector functions for these lanes (glibc's vector ABI); empty for none.
    """

    number: int
    variant: str


@cache
def lanes_of_this_machine() -> Lanes:
    """The widest lanes of this processor: AVX-512, AVX2, or 128 bits (SSE2, NEON)."""
    features = llvm.get_host_cpu_features()
    if platform.machine().lower() in ("aarch64", "arm64"):
        return Lanes(2, "n")
    if features.get("avx512f") and features.get("avx512dq"):
        return Lanes(8, "e")
    if features.get("avx2") and features.get("fma"):
        return Lanes(4, "d")
    return Lanes(2, "b")


@cache
def symbol(name: str, lanes: Lanes) -> str | None:
    """The C library's vector function for these lanes, made known to LLVM; None where the library has none."""
    library = _vector_library()
    found = f"_ZGV{lanes.variant}N{lanes.number}{'v' * FUNCTIONS[name]}_{name}"
    if library is None or not lanes.variant or not hasattr(library, found):
        return None
    _publish(library, found)
    return found


@cache
def publish_scalar_functions() -> None:
    """Make the C library's functions of one number, and those of memory, known to LLVM."""
    library = ctypes.CDLL("ucrtbase" if sys.platform == "win32" else ctypes.util.find_library("m"))
    for name in (*FUNCTIONS, *(n for n in ROUNDED.values() if n != "fabs"), "malloc", "free"):
        _publish(library, name)


@cache
def _vector_library() -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL("libmvec.so.1")  # the vector functions of glibc 2.22, all of them since 2.35
    except OSError:
        return None


def _publish(library: ctypes.CDLL, name: str) -> None:
    llvm.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0)
