"""C99 files that need nothing but the mathematics of the C library: a policy, a twin's interval, and any function.

Functions of tensors are traced, compiled, called, and written with a header after a comparison.
"""

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
from rt_torchrl.export.agreement import (
    OBSERVATIONS,
    SEED,
    action_sizes,
    detached,
    frozen,
    require_close,
    sample_observations,
    sizes,
)
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal, bounds
from rt_torchrl.programs.c_source import CSource
from rt_torchrl.programs.program import Program, UntraceableError
from rt_torchrl.programs.rules import new_tracer

NOTE = "It has no memory, allocates nothing, may be called from several threads, and needs only math.h."
COMPILERS = ("cc", "gcc", "clang")
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror")
TOLERANCE = 1e-9
"""Greatest difference of a number in C from that in torch, as a share of the range or size of its signal."""
FLIGHTS, INTERVALS = 20, 20
"""Flights under random commands on which a twin is compared, and their lengths."""
REMEDY = "Write it with arithmetic of torch in float64; ONNX takes more of a policy than C does."

Exported = tuple[Callable[..., Mapping[str, Tensor]], Mapping[str, Tensor], Tensor, Tensor]
"""A function, its arguments at the points of the comparison, and its values and their sizes there."""


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


def named(path: Path | str, name: str | None, usual: str) -> tuple[Path, str]:
    """The path of a C file and the name of its functions, or the usual one for None, after a check of both.

    Raises:
        ValueError: if the path does not end in ``.c``, or C does not take the name.
    """
    name = usual if name is None else name
    if Path(path).suffix != ".c":
        raise ValueError(f"path={path} of a C file must end in .c; the header's name is made of it.")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ValueError(f"function={name!r} must be a name in C, such as blade_controller.")
    return Path(path), name


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


def _write(
    path: Path,
    name: str,
    what: str,
    module: nn.Module,
    functions: Mapping[str, Exported],
    signals: Sequence[Signal],
    comment: Sequence[str],
) -> float | None:
    """Write functions of signals, by their names in C, with the weights of a module; return the greatest difference."""
    source, heads = source_of(module), []
    for c_name, (function, points, _, _) in functions.items():
        example = {argument: x[:1] for argument, x in points.items()}
        heads.append(add_function(source, c_name, traced(what, function, example, module)))

    def compare(library: ctypes.CDLL) -> float:
        errors = []
        for c_name, (_, points, expected, of) in functions.items():
            values = answers(getattr(library, c_name), points, len(signals))
            errors.append(require_close(values, expected, of, TOLERANCE, signals, f"{c_name} in C"))
        return max(errors)

    return write_c(path, name, comment, [f"{head};" for head in heads], source, compare)


def export_c(policy: nn.Module, path: Path | str, plant: Plant, *, function: str | None = None) -> float | None:
    """Write a policy as C99: one function ``void <function>(const double *observation, double *action)``.

    The function holds weights, normalisation and saturation. It allocates nothing, keeps nothing between calls and
    needs only ``math.h``. The header describes observations and actions, with units and ranges.
    :func:`export_controller` also writes what makes the observation of measured signals.

    The check compiles the file and calls the function. If there is no compiler, a warning says that the check was left
    out.

    Args:
        policy: any ``policy(observation) -> action`` in double precision that can be traced to arithmetic.
        path: file to write, such as ``policy.c``; the header gets the same name with ``.h``.
        plant: plant with the policy's observations and actions.
        function: name of the function; by default the name of the plant with ``_policy``.

    Returns:
        Greatest difference from the policy, as a share of the range of an action; None without a check.

    Raises:
        ValueError: if the path or the name does not fit, the policy does not fit the plant or cannot be traced (the
            message names the line), the file does not compile, or the function does not agree with the policy.
    """
    (path, name), policy = named(path, function, f"{plant.name}_policy"), detached(policy, plant)
    points = sample_observations(plant.observations, OBSERVATIONS)
    with torch.no_grad():
        expected = policy(points)

    def act(observation: Tensor) -> dict[str, Tensor]:
        return {"action": policy(observation)}

    functions = {name: (act, {"observation": points}, expected, action_sizes(plant, expected))}
    what, comment = f"policy {type(policy).__name__}", _about_policy(policy, plant, name)
    return _write(path, name, what, policy, functions, plant.actions, comment)


def _about_policy(policy: nn.Module, plant: Plant, name: str) -> list[str]:
    kind = type(plant)
    return [
        f"{name}: a policy of the plant {plant.name} ({type(policy).__name__}), written by rt_torchrl.",
        f"Call it once every {plant.dt:g} s, the plant's control interval, and hold the action in between.",
        NOTE,
        "A NaN in an observation gives NaN in every action that depends on it: check your sensors before.",
        "",
        *signal_table({"observation": plant.observations, "action": plant.actions}),
        *(f"observation[{k}] is {m.scaling}." for k, m in enumerate(plant.observed) if m.scaling),
        f"Observations are made of states and inputs by {kind.__name__}.observe, in {kind.__module__}.",
    ]


def export_twin(closure: nn.Module, path: Path | str, plant: Plant, *, name: str | None = None) -> float | None:
    """Write a control interval of a plant with a learned closure as C99.

    The function is ``void <name>_step(double t, const double *state, const double *command, const double *exogenous,
    double *next)``, which is :meth:`Plant.step`; ``next`` may be ``state``. It allocates nothing, keeps nothing between
    calls and needs only ``math.h``.

    A plant with states that no sensor reads, such as that of a hypothesis, also gets ``void <name>_rest(const double
    *read, double *state)``, which is :meth:`Plant.at_rest`: the states at the start of an episode.

    The check compiles the file and compares it on flights under random commands.

    Args:
        closure: the learned closure, such as ``run.twin.believed.closure``.
        path: file to write, such as ``twin.c``; the header gets the same name with ``.h``.
        plant: the physics that the closure belongs to, such as ``run.twin.believed.plant``.
        name: prefix of the function; by default the name of the plant with ``_twin``.

    Returns:
        Greatest difference of a state from that in torch, as a share of its size: its own, and at least the greatest
        one after the first interval of the flights. None without a compiler.

    Raises:
        ValueError: if the path or the name does not fit, plant or closure cannot be traced (the message names the
            line), the file does not compile, or the function does not agree with the plant.
    """
    path, name = named(path, name, f"{plant.name}_twin")
    plant, closure = frozen(plant), frozen(closure)
    points, ends = _flights(plant, closure)

    def step(**point: Tensor) -> dict[str, Tensor]:
        return {"next": plant.step(**point, closure=closure).state}

    def rest(read: Tensor) -> dict[str, Tensor]:
        return {"state": plant.at_rest(read)}

    # The sizes of a flight that runs away say nothing of others.
    of = torch.maximum(ends.abs(), sizes(ends[:FLIGHTS]))
    functions: dict[str, Exported] = {f"{name}_step": (step, points, ends, of)}
    if plant.unread:
        read = points["state"][:, : len(plant.readings)]
        start = plant.at_rest(read).detach()
        functions[f"{name}_rest"] = rest, {"read": read}, start, sizes(start)
    what, comment = f"the twin of plant {plant.name!r}", _about_twin(plant, closure, name)
    return _write(path, name, what, closure, functions, plant.states, comment)


@torch.no_grad()
def _flights(plant: Plant, closure: nn.Module) -> tuple[dict[str, Tensor], Tensor]:
    """Times, states, commands and inputs of many intervals, and the states at their ends."""
    generator, n = torch.Generator().manual_seed(SEED), min(plant.n_steps, INTERVALS)
    state, exogenous = plant.draw_initial_state(FLIGHTS, generator), plant.draw_exogenous(FLIGHTS, generator)
    low, high = (end.clamp(-1e3, 1e3) if end.isinf().any() else end for end in bounds(plant.actions))
    share = torch.rand(n, FLIGHTS, len(plant.actions), generator=generator, dtype=torch.float64)
    times, states = [torch.full((FLIGHTS,), k * plant.dt, dtype=torch.float64) for k in range(n)], [state]
    commands = low + (high - low) * share
    for k, t in enumerate(times):
        states.append(plant.step(t, states[-1], commands[k], exogenous[:, k], closure).state)
    points = {"t": torch.cat(times), "state": torch.cat(states[:-1]), "command": commands.flatten(0, 1)}
    return points | {"exogenous": exogenous[:, :n].transpose(0, 1).flatten(0, 1)}, torch.cat(states[1:])


def _about_twin(plant: Plant, closure: nn.Module, name: str) -> list[str]:
    read = len(plant.readings)
    rest = f"{name}_rest(read, state) gives all states at the start of an episode, of the first {read}, which are read."
    return [
        f"{name}: a twin of the plant {plant.name} with the closure {type(closure).__name__}, written by rt_torchrl.",
        f"{name}_step(t, state, command, exogenous, next) takes the state over one control interval of {plant.dt:g} s,",
        "which starts at t [s], under a held command and held inputs; next may be state.",
        *([rest] if plant.unread else []),
        NOTE,
        "A state that leaves the range of a table becomes NaN.",
        "",
        *signal_table({"state": plant.states, "command": plant.actions, "exogenous": plant.inputs}),
    ]
