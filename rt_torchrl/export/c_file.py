"""Functions of tensors as a C99 file with its header: traced, compiled, called, and written after a comparison."""

import ctypes
import math
import re
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.plants.signal import Signal
from rt_torchrl.programs.c_source import CSource
from rt_torchrl.programs.program import Program, UntraceableError
from rt_torchrl.programs.rules import new_tracer

NOTE = "It has no memory, allocates nothing, may be called from several threads, and needs only math.h."
COMPILERS = ("cc", "gcc", "clang")
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror")
TOLERANCE = 1e-9
"""Greatest difference of a number in C from that in torch, as a share of the range or size of its signal."""
REMEDY = "Write it with arithmetic of torch in float64; ONNX takes more of a policy than C does."


class TracedFunction(NamedTuple):
    """A program with the values of its outputs.

    Args:
        program: the program; its inputs have the name of an argument and a position.
        arguments: example of every argument. Those of one dimension are numbers in C, those of two are arrays.
        outputs: values of every output.
    """

    program: Program
    arguments: Mapping[str, Tensor]
    outputs: dict[str, list[int]]

    def reads(self, name: str) -> set[int]:
        """The positions of an argument that the outputs depend on."""
        needed = self.program.needed(value for values in self.outputs.values() for value in values)
        operations = [self.program.operations[value] for value in needed]
        return {o.attributes[1] for o in operations if o.name == "input" and o.attributes[0] == name}


def traced(
    what: str,
    function: Callable[..., Mapping[str, Tensor]],
    arguments: Mapping[str, Tensor],
    module: nn.Module | None = None,
) -> TracedFunction:
    """Trace a function of vectors, one realisation.

    Args:
        what: name of the function, for messages.
        function: function of tensors that returns tensors by name.
        arguments: example of every argument, with one realisation.
        module: module from :func:`~rt_torchrl.export.agreement.frozen` whose weights the C file holds.

    Raises:
        UntraceableError: if the function cannot become a program; the message names the reason and the line.
    """
    tracer, inputs = new_tracer(), {name: value.clone() for name, value in arguments.items()}
    try:
        for name, value in inputs.items():
            tracer.input(value, name)
        for weight in [] if module is None else module.parameters():
            tracer.weight(weight)
        with torch.no_grad(), tracer.following():
            results = function(**inputs)
        outputs = {name: tracer.outputs(value) for name, value in results.items()}
    except UntraceableError as error:
        raise UntraceableError(f"{what} cannot be written in C: {error}. {REMEDY}") from error
    return TracedFunction(tracer.program, arguments, outputs)


def source_of(module: nn.Module) -> CSource:
    """The beginning of a C file, with the weights of a module in the order in which :func:`traced` numbers them."""
    weights = {f"{name} {tuple(x.shape)}": x.detach().flatten().tolist() for name, x in module.named_parameters()}
    return CSource(list(weights.items()))


def add_function(
    source: CSource,
    name: str,
    function: TracedFunction,
    places: Mapping[str, Sequence[int]] | None = None,
    kind: str = "void",
) -> str:
    """Add a function to a C file, and return its declaration; the outputs are its last arguments.

    Args:
        source: the C file.
        name: name in C.
        function: the traced function.
        places: positions of the elements of an argument that its array in C has; by default all.
        kind: what stands before the name.
    """
    inputs, declared = dict[tuple[str, int], str](), list[str]()
    for argument, value in function.arguments.items():
        if value.ndim == 1:
            declared.append(f"double {argument}")
            inputs[argument, 0] = argument
            continue
        declared.append(f"const double *{argument}")
        positions = (places or {}).get(argument, range(value.shape[1]))
        inputs |= {(argument, k): f"{argument}[{place}]" for place, k in enumerate(positions)}
    outputs = [(f"{output}[{k}]", x) for output, values in function.outputs.items() for k, x in enumerate(values)]
    declared += [f"double *{output}" for output in function.outputs]
    head = f"{kind} {name}({', '.join(declared)})"
    source.add(head, function.program, inputs, outputs)
    return head


def answers(function: Any, points: Mapping[str, Tensor], count: int) -> Tensor:
    """What a compiled function of :func:`add_function` gives for every row of its arguments, ``count`` numbers each."""
    columns = [x.tolist() for x in points.values()]
    rows = (
        [c_array(x) if isinstance(x, list) else ctypes.c_double(x) for x in row] for row in zip(*columns, strict=True)
    )
    return torch.stack([called(function, row, count) for row in rows])


def c_array(numbers: Sequence[float]) -> ctypes.Array[ctypes.c_double]:
    """An array of doubles for a call."""
    return (ctypes.c_double * max(1, len(numbers)))(*numbers)


def called(function: Any, arguments: Sequence[Any], count: int) -> Tensor:
    """The ``count`` numbers that a function writes into the array after its arguments."""
    out = c_array([math.nan] * count)
    function.restype = None
    function(*arguments, out)
    return torch.tensor(list(out)[:count], dtype=torch.float64)


def compiler() -> str | None:
    """The compiler of this machine; None if it has none."""
    return next(filter(None, map(shutil.which, COMPILERS)), None)


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


def require_names(path: Path | str, name: str) -> Path:
    """The path of a C file, after a check of it and of the name of its functions.

    Raises:
        ValueError: if the path does not end in ``.c``, or C does not take the name.
    """
    if Path(path).suffix != ".c":
        raise ValueError(f"path={path} of a C file must end in .c; the header's name is made of it.")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ValueError(f"function={name!r} must be a name in C, such as blade_controller.")
    return Path(path)


def write_c(
    path: Path,
    name: str,
    comment: Sequence[str],
    declarations: Sequence[str],
    source: CSource,
    compare: Callable[[ctypes.CDLL], float],
) -> float | None:
    """Write a C file and its header of the same name, after they were compiled and compared with what they are made of.

    Args:
        path: the C file.
        name: name of its function, or the prefix of its functions.
        comment: lines of the comment at the top of the header.
        declarations: lines of C in the header.
        source: the functions.
        compare: comparison of the loaded library, which raises ValueError on a difference.

    Returns:
        The result of the comparison; None without a compiler, of which a warning tells.

    Raises:
        ValueError: if the file does not compile without a warning, or the comparison fails; then nothing is written.
    """
    header, result, cc = path.with_suffix(".h"), None, compiler()
    note = f"/* See {header.name} for what goes in and out. Written by rt_torchrl; do not edit. */"
    texts = {
        header: header_text(name, comment, declarations),
        path: f'{note}\n\n#include "{header.name}"\n\n#include <math.h>\n\n{source.text()}',
    }
    if cc is None:
        warnings.warn(
            f"{name} was not checked: there is no C compiler here ({', '.join(COMPILERS)}). Compare it where you "
            "compile it.",
            stacklevel=3,
        )
    else:
        with tempfile.TemporaryDirectory() as folder:
            for file, text in texts.items():
                Path(folder, file.name).write_text(text, encoding="utf-8")
            result = compare(ctypes.CDLL(str(compile_c(cc, Path(folder, path.name), *STRICT))))
    for file, text in texts.items():
        write_atomically(file, text.encode("utf-8"))
    return result


def header_text(name: str, comment: Sequence[str], declarations: Sequence[str]) -> str:
    """The text of a header with a comment at its top."""
    guard, declared = f"{name.upper()}_H", "\n".join(declarations)
    lines = "\n".join(f" * {line}".rstrip() for line in (line.replace("*/", "* /") for line in comment))
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
    return ["  ".join(row) for row in rows]
