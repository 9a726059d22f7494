"""The policy as a C99 file and its header, which need nothing but the mathematics of the C library."""

import ctypes
import math
import re
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.export.agreement import detached, require_agreement, sample_observations
from rt_torchrl.export.c_function import CFunction
from rt_torchrl.export.program import trace
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

COMPILERS = ("cc", "gcc", "clang")
EXAMPLES = 3
"""Number of observations with their actions in the header, to test the function on its target machine."""


def export_c(policy: nn.Module, path: Path | str, plant: Plant, *, function: str | None = None) -> float | None:
    """Write a policy as C99: one function ``void <function>(const double *observation, double *action)``.

    The function holds weights, normalisation and saturation. It allocates nothing, keeps nothing between calls and
    needs only ``math.h``. The header describes observations and actions, with units and ranges, and gives examples. A
    policy may be built of anything that torch.export traces to the operators of :mod:`.c_operators`: Linear layers,
    activations, LayerNorm, BatchNorm, arithmetic, choosing and joining of elements.

    The check compiles the file and calls the function. If there is no compiler, a warning says that the check was left
    out.

    Args:
        policy: any ``policy(observation) -> action`` in double precision, built of such operators.
        path: file to write, such as ``policy.c``; the header gets the same name with ``.h``.
        plant: plant with the policy's observations and actions.
        function: name of the function; by default the name of the plant with ``_policy``.

    Returns:
        Greatest difference from the policy, see :func:`require_agreement`; None without a check.

    Raises:
        ValueError: if the path or the name does not fit, the policy does not fit the plant, a layer has no C form (the
            message names it), the file does not compile, or the function does not agree with the policy.
    """
    path, function = Path(path), f"{plant.name}_policy" if function is None else function
    if path.suffix != ".c":
        raise ValueError(f"path={path} of a C file must end in .c; the header's name is made of it.")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", function):
        raise ValueError(f"function={function!r} must be a name in C, such as {plant.name}_policy.")
    policy = detached(policy, plant)
    written = CFunction(trace(policy, plant, batch=1), type(policy).__name__)
    header = _header(policy, plant, function)
    source = _source(written, path.with_suffix(".h").name, function)
    error = _check(policy, plant, function, path.with_suffix(".h").name, header, source)
    path.with_suffix(".h").write_text(header, encoding="utf-8")
    path.write_text(source, encoding="utf-8")
    return error


def _source(written: CFunction, header: str, function: str) -> str:
    body = written.body
    # A compiler warns of an argument that the function does not read.
    unread = [] if any("observation[" in line for line in body.statements) else ["(void)observation;"]
    lines = [*unread, *body.statements]
    parts = [
        f"/* See {header} for what goes in and out. Written by rt_torchrl; do not edit. */",
        f'#include "{header}"\n\n#include <math.h>',
        *body.constants,
        f"void {function}(const double *observation, double *action)\n{{\n    "
        + "\n    ".join(line.replace("\n", "\n    ") for line in lines)
        + "\n}\n",
    ]
    return "\n\n".join(parts)


def _header(policy: nn.Module, plant: Plant, function: str) -> str:
    guard = f"{function.upper()}_H"
    kind = type(plant)
    lines = [
        f"{function}: a policy of the plant {plant.name} ({type(policy).__name__}), written by rt_torchrl.",
        "",
        f"Call it once every {plant.dt:g} s, the plant's control interval, and hold the action in between.",
        "It has no memory, allocates nothing, may be called from several threads, and needs only math.h.",
        "A NaN in an observation gives NaN in every action that depends on it: check your sensors before.",
        "",
        *_table(plant),
        "",
        f"Observations are made of states and inputs by {kind.__name__}.observe, in {kind.__module__}.",
        "A range of observations is where they usually lie; actions never leave theirs, if the policy saturates.",
        "",
        "Examples, to try it on the machine it is meant for:",
        *_examples(policy, plant),
    ]
    comment = "\n".join(f" * {line}".rstrip() for line in (line.replace("*/", "* /") for line in lines))
    return f"""/*
{comment}
 */
#ifndef {guard}
#define {guard}

#define {function.upper()}_OBSERVATIONS {len(plant.observations)}
#define {function.upper()}_ACTIONS {len(plant.actions)}

#ifdef __cplusplus
extern "C" {{
#endif

void {function}(const double *observation, double *action);

#ifdef __cplusplus
}}
#endif

#endif
"""


def _table(plant: Plant) -> list[str]:
    """A line for each component, with its place, name, unit and range."""

    def range_of(signal: Signal) -> str:
        low, high = (f"{bound:.10g}" if math.isfinite(bound) else "unbounded" for bound in (signal.low, signal.high))
        return low if low == high else f"{low} ... {high}"

    rows = [
        (f"{array}[{k}]", signal.name, f"[{signal.unit}]", range_of(signal))
        for array, signals in (("observation", plant.observations), ("action", plant.actions))
        for k, signal in enumerate(signals)
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _examples(policy: nn.Module, plant: Plant) -> list[str]:
    observations = sample_observations(plant.observations, EXAMPLES)

    def row(values: Tensor) -> str:
        return "{" + ", ".join(f"{value:.9g}" for value in values.tolist()) + "}"

    # The actions are those of the rounded observations, so that the printed numbers are what goes in.
    observations = torch.tensor(
        [[float(f"{v:.9g}") for v in row_] for row_ in observations.tolist()], dtype=torch.float64
    )
    return [f"{row(o)} -> {row(a)}" for o, a in zip(observations, policy(observations), strict=True)]


def _check(policy: nn.Module, plant: Plant, function: str, header_name: str, header: str, source: str) -> float | None:
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        warnings.warn(
            f"{function} was not checked against the policy: there is no C compiler here ({', '.join(COMPILERS)}). Try "
            "the examples of its header where you compile it.",
            stacklevel=3,
        )
        return None
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / header_name).write_text(header, encoding="utf-8")
        file = Path(folder) / "checked.c"
        file.write_text(source, encoding="utf-8")
        compiled = load_c(compile_c(compiler, file), function, len(plant.actions))
        return require_agreement(policy, compiled, plant, what="the C function")


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


def load_c(library: Path, function: str, n_actions: int) -> Callable[[Float[Tensor, "n n_o"]], Float[Tensor, "n n_a"]]:
    """The compiled function, applied to every row of observations."""
    compiled = getattr(ctypes.CDLL(str(library)), function)
    compiled.restype = None

    def run(observations: Float[Tensor, "n n_o"]) -> Float[Tensor, "n n_a"]:
        rows = []
        for observation in observations.tolist():
            action = (ctypes.c_double * n_actions)(*([math.nan] * n_actions))
            compiled((ctypes.c_double * len(observation))(*observation), action)
            rows.append(list(action))
        return torch.tensor(rows, dtype=torch.float64)

    return run
