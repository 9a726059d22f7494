"""A twin as a C99 file: one control interval of a plant with its learned closure."""

import ctypes
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rt_torchrl.export.agreement import SEED
from rt_torchrl.export.c_compiler import c_array, called
from rt_torchrl.export.c_file import CFile, signal_table
from rt_torchrl.export.traced_function import frozen, traced, weights_of
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.programs.c_source import CSource

TOLERANCE = 1e-9
"""Greatest difference of a state in C from that in torch, as a share of the greatest size of the state."""
FLIGHTS, INTERVALS = 20, 20
"""Flights under random commands on which both are compared, and their lengths."""
ARGUMENTS = ("t", "state", "command", "exogenous")


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
        Greatest difference of a state from that in torch, as a share of the greatest size of the state; None without a
        compiler.

    Raises:
        ValueError: if the path or the name does not fit, plant or closure cannot be traced (the message names the
            line), the file does not compile, or the function does not agree with the plant.
    """
    file = CFile(path, f"{plant.name}_twin" if name is None else name)
    plant, closure = frozen(plant), frozen(closure)
    points, ends = _flights(plant, closure)
    head, source = _source(plant, closure, file.name, {argument: x[:1] for argument, x in points.items()})
    heads = [head, *_add_rest(source, plant, file.name)]

    def compare(library: ctypes.CDLL) -> float:
        error = _difference(getattr(library, f"{file.name}_step"), points, ends, file.name)
        if plant.unread:
            error = max(error, _rest_difference(getattr(library, f"{file.name}_rest"), plant, points["state"]))
        return error

    return file.write(_comment(plant, closure, file.name), [f"{head};" for head in heads], source, compare)


def _source(plant: Plant, closure: nn.Module, name: str, example: dict[str, Tensor]) -> tuple[str, CSource]:
    """The declaration of the function, and the functions."""
    found = traced(
        f"the twin of plant {plant.name!r}",
        lambda **given: {"next": plant.step(**given, closure=closure).state},
        example,
        [closure],
    )
    sizes = {"state": len(plant.states), "command": len(plant.actions), "exogenous": len(plant.inputs)}
    inputs = {(array, k): f"{array}[{k}]" for array, size in sizes.items() for k in range(size)} | {("t", 0): "t"}
    arrays = ", ".join(f"const double *{array}" for array in sizes)
    head = f"void {name}_step(double t, {arrays}, double *next)"
    source = CSource(weights_of({"closure": closure}))
    source.add(head, found.program, inputs, [(f"next[{k}]", v) for k, v in enumerate(found.outputs["next"])])
    return head, source


def _add_rest(source: CSource, plant: Plant, name: str) -> list[str]:
    """Add the function of the states at the start, and return its declaration; a plant that is read wholly has none."""
    if not plant.unread:
        return []
    read = plant.draw_initial_state(1, torch.Generator().manual_seed(SEED))[:, : len(plant.readings)]
    found = traced(f"the start of plant {plant.name!r}", lambda read: {"state": plant.at_rest(read)}, {"read": read})
    head = f"void {name}_rest(const double *read, double *state)"
    inputs = {("read", k): f"read[{k}]" for k in range(len(plant.readings))}
    source.add(head, found.program, inputs, [(f"state[{k}]", v) for k, v in enumerate(found.outputs["state"])])
    return [head]


@torch.no_grad()
def _flights(plant: Plant, closure: nn.Module) -> tuple[dict[str, Tensor], Tensor]:
    """Times, states, commands and inputs of many intervals, and the states at their ends."""
    generator = torch.Generator().manual_seed(SEED)
    state, exogenous = plant.draw_initial_state(FLIGHTS, generator), plant.draw_exogenous(FLIGHTS, generator)
    low, high = (end.clamp(-1e3, 1e3) if end.isinf().any() else end for end in bounds(plant.actions))
    found, ends = [], []
    for k in range(min(plant.n_steps, INTERVALS)):
        t = torch.full((FLIGHTS, 1), k * plant.dt, dtype=torch.float64)
        share = torch.rand(FLIGHTS, len(plant.actions), generator=generator, dtype=torch.float64)
        found.append((t, state, low + (high - low) * share, exogenous[:, k]))
        state = plant.step(t[:, 0], *found[-1][1:], closure).state
        ends.append(state)
    arguments = (torch.cat(parts) for parts in zip(*found, strict=True))
    points = dict(zip(ARGUMENTS, arguments, strict=True))
    return {**points, "t": points["t"][:, 0]}, torch.cat(ends)


def _difference(function: Any, points: dict[str, Tensor], ends: Tensor, name: str) -> float:
    rows = zip(*(points[argument].tolist() for argument in ARGUMENTS), strict=True)
    found = torch.stack(
        [called(function, [ctypes.c_double(t), *map(c_array, arrays)], ends.shape[1]) for t, *arrays in rows]
    )
    size = ends.abs().nan_to_num(nan=0.0, posinf=0.0).amax(0).clamp(min=torch.finfo(torch.float64).tiny)
    equal = (found == ends) | (found.isnan() & ends.isnan())
    errors = torch.where(equal, 0.0, ((found - ends).abs() / size).nan_to_num(nan=torch.inf))
    if errors.max() > TOLERANCE:
        row = int(errors.amax(-1).argmax())
        raise ValueError(
            f"{name}_step in C differs from the twin by {errors.max().item():.2g} of the size of a state at state "
            f"{points['state'][row].tolist()} under command {points['command'][row].tolist()}; at most {TOLERANCE:g} "
            "is allowed, and nothing was written."
        )
    return errors.max().item()


@torch.no_grad()
def _rest_difference(function: Any, plant: Plant, states: Tensor) -> float:
    """Greatest difference of a state at rest from that in torch, as a share of the greatest size of the state."""
    read = states[:, : len(plant.readings)]
    expected = plant.at_rest(read)
    found = torch.stack([called(function, [c_array(row)], expected.shape[1]) for row in read.tolist()])
    size = expected.abs().amax(0).clamp(min=torch.finfo(torch.float64).tiny)
    error = ((found - expected).abs() / size).max().item()
    if not error <= TOLERANCE:
        raise ValueError(f"the states at rest of plant {plant.name!r} differ in C by {error:.2g}; nothing was written.")
    return error


def _comment(plant: Plant, closure: nn.Module, name: str) -> list[str]:
    signals = {"state": plant.states, "command": plant.actions, "exogenous": plant.inputs}
    read, every = len(plant.readings), len(plant.states)
    rest = [
        f"No sensor reads the last {plant.unread} of the states. At the start of an episode they follow:",
        "",
        f"    {name}_rest(read, state);    read has the first {read} states, state all {every}, maybe in its place",
        "",
    ]
    return [
        f"{name}: a twin of the plant {plant.name} with the closure {type(closure).__name__}, written by rt_torchrl.",
        "",
        f"    {name}_step(t, state, command, exogenous, next);    next may be state",
        "",
        f"It takes the state over one control interval of {plant.dt:g} s, which starts at t [s]. Command and exogenous",
        "inputs are held. It has no memory, allocates nothing, may be called from several threads, and needs only",
        "math.h. A state that leaves the range of a table becomes NaN.",
        "",
        *(rest if plant.unread else []),
        *signal_table(signals),
    ]
