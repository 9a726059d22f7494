"""A C file with its header, which are written together after a check."""

import ctypes
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.export.c_compiler import checked
from rt_torchrl.plants.signal import Signal
from rt_torchrl.programs.c_source import CSource

Found = TypeVar("Found")


class CFile:
    """A C file and its header of the same name.

    Args:
        path: the C file, which ends in ``.c``.
        name: name of its function, or the prefix of its functions.

    Raises:
        ValueError: if the path has another suffix, or C does not take the name.
    """

    def __init__(self, path: Path | str, name: str):
        self.path, self.name = Path(path), name
        if self.path.suffix != ".c":
            raise ValueError(f"path={path} of a C file must end in .c; the header's name is made of it.")
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
            raise ValueError(f"function={name!r} must be a name in C, such as blade_controller.")

    def write(
        self,
        comment: Sequence[str],
        declarations: Sequence[str],
        source: CSource,
        compare: Callable[[ctypes.CDLL], Found],
    ) -> Found | None:
        """Check and write both files.

        Args:
            comment: lines of the comment at the top of the header.
            declarations: lines of C in the header.
            source: the functions.
            compare: comparison of the loaded library, which raises ValueError on a difference.

        Returns:
            The result of the comparison; None without a compiler.

        Raises:
            ValueError: if the file does not compile, or the comparison fails; then nothing is written.
        """
        header = self.path.with_suffix(".h")
        texts = {
            header: header_text(self.name, comment, declarations),
            self.path: source_text(header.name, source.text()),
        }
        found = checked({path.name: text for path, text in texts.items()}, self.name, compare)
        for path, text in texts.items():
            write_atomically(path, text.encode("utf-8"))
        return found


def header_text(name: str, comment: Sequence[str], declarations: Sequence[str]) -> str:
    """The text of a header.

    Args:
        name: name in C from which the guard is made.
        comment: lines of the comment at its top.
        declarations: lines of C.
    """
    guard = f"{name.upper()}_H"
    lines = "\n".join(f" * {line}".rstrip() for line in (line.replace("*/", "* /") for line in comment))
    declared = "\n".join(declarations)
    return f"""/*
{lines}
 */
#ifndef {guard}
#define {guard}

#ifdef __cplusplus
extern "C" {{
#endif

{declared}

#ifdef __cplusplus
}}
#endif

#endif
"""


def source_text(header: str, content: str) -> str:
    """The text of a C file with its header and the functions."""
    note = f"/* See {header} for what goes in and out. Written by rt_torchrl; do not edit. */"
    return f'{note}\n\n#include "{header}"\n\n#include <math.h>\n\n{content}'


def signal_table(arrays: Mapping[str, Sequence[Signal]]) -> list[str]:
    """A line for each signal, with its place in C, name, unit and range."""

    def range_of(signal: Signal) -> str:
        low, high = (f"{bound:.10g}" if math.isfinite(bound) else "unbounded" for bound in (signal.low, signal.high))
        return low if low == high else f"{low} ... {high}"

    rows = [
        (f"{array}[{k}]", signal.name, f"[{signal.unit}]", range_of(signal))
        for array, signals in arrays.items()
        for k, signal in enumerate(signals)
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
