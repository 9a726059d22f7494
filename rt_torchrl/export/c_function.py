"""A policy, and a twin's control interval, as C99 functions that need nothing but the mathematics of the C library."""

import ctypes
from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.export import c_file
from rt_torchrl.export.agreement import (
    SEED,
    detached,
    frozen,
    require_close,
    require_policy,
    sample_observations,
    sizes,
)
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds

Function = Callable[..., dict[str, Tensor]]
TOLERANCE = 1e-9
"""Greatest difference of a state in C from that in torch, as a share of the greatest size of the state."""
FLIGHTS, INTERVALS = 20, 20
"""Flights under random commands on which a twin is compared, and their lengths."""


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
    name = f"{plant.name}_policy" if function is None else function
    path, policy = c_file.require_names(path, name), detached(policy, plant)
    source = c_file.source_of("policy", policy)
    example = {"observation": sample_observations(plant.observations, 1)}
    what = f"policy {type(policy).__name__}"
    program = c_file.traced(what, lambda observation: {"action": policy(observation)}, example, policy)
    head = c_file.add_function(source, name, program, example)

    def compare(library: ctypes.CDLL) -> float:
        def compiled(rows: Tensor) -> Tensor:
            return c_file.answers(getattr(library, name), {"observation": rows}, len(plant.actions))

        return require_policy(policy, compiled, plant, "the C function")

    macros = [
        f"#define {name.upper()}_OBSERVATIONS {len(plant.observations)}",
        f"#define {name.upper()}_ACTIONS {len(plant.actions)}",
    ]
    return c_file.write_c(path, name, _about_policy(policy, plant, name), [*macros, "", f"{head};"], source, compare)


def _about_policy(policy: nn.Module, plant: Plant, name: str) -> list[str]:
    kind = type(plant)
    return [
        f"{name}: a policy of the plant {plant.name} ({type(policy).__name__}), written by rt_torchrl.",
        "",
        f"Call it once every {plant.dt:g} s, the plant's control interval, and hold the action in between.",
        "It has no memory, allocates nothing, may be called from several threads, and needs only math.h.",
        "A NaN in an observation gives NaN in every action that depends on it: check your sensors before.",
        "",
        *c_file.signal_table({"observation": plant.observations, "action": plant.actions}),
        *(f"observation[{k}] is {m.scaling}." for k, m in enumerate(plant.observed) if m.scaling),
        "",
        f"Observations are made of states and inputs by {kind.__name__}.observe, in {kind.__module__}.",
        "A range of observations is where they usually lie; actions never leave theirs, if the policy saturates.",
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
    name = f"{plant.name}_twin" if name is None else name
    path, plant, closure = c_file.require_names(path, name), frozen(plant), frozen(closure)
    points, ends = _flights(plant, closure)

    def step(**point: Tensor) -> dict[str, Tensor]:
        return {"next": plant.step(**point, closure=closure).state}

    def rest(read: Tensor) -> dict[str, Tensor]:
        return {"state": plant.at_rest(read)}

    functions: dict[str, tuple[Function, dict[str, Tensor], Tensor]] = {f"{name}_step": (step, points, ends)}
    if plant.unread:
        read = points["state"][:, : len(plant.readings)]
        functions[f"{name}_rest"] = (rest, {"read": read}, plant.at_rest(read).detach())
    source = c_file.source_of("closure", closure)
    heads = []
    for called, (function, inputs, _) in functions.items():
        example = {argument: x[:1] for argument, x in inputs.items()}
        part = c_file.traced(f"the twin of plant {plant.name!r}", function, example, closure)
        heads.append(c_file.add_function(source, called, part, example))

    def compare(library: ctypes.CDLL) -> float:
        errors = []
        for called, (_, inputs, expected) in functions.items():
            values = c_file.answers(getattr(library, called), inputs, len(plant.states))
            rows = [
                dict(zip(inputs, row, strict=True)) for row in zip(*(x.tolist() for x in inputs.values()), strict=True)
            ]
            what = f"{called} in C"
            # The sizes of a flight that runs away say nothing of others.
            of = torch.maximum(expected.abs(), sizes(expected[:FLIGHTS]))
            errors.append(require_close(values, expected, of, TOLERANCE, plant.states, what, rows))
        return max(errors)

    return c_file.write_c(
        path, name, _about_twin(plant, closure, name), [f"{head};" for head in heads], source, compare
    )


@torch.no_grad()
def _flights(plant: Plant, closure: nn.Module) -> tuple[dict[str, Tensor], Float[Tensor, "n n_s"]]:
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
    read, total = len(plant.readings), len(plant.states)
    rest = [
        f"No sensor reads the last {plant.unread} of the states. At the start of an episode they follow:",
        "",
        f"    {name}_rest(read, state);    read has the first {read} states, state all {total}, maybe in its place",
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
        *c_file.signal_table({"state": plant.states, "command": plant.actions, "exogenous": plant.inputs}),
    ]
