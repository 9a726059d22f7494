"""A policy, and a twin's control interval, as C99 functions that need nothing but the mathematics of the C library."""

import ctypes
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from rt_torchrl.export import c_file
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

FLIGHTS, INTERVALS = 20, 20
"""Flights under random commands on which a twin is compared, and their lengths."""


Exported = tuple[Callable[..., Mapping[str, Tensor]], Mapping[str, Tensor], Tensor, Tensor]
"""A function, its arguments at the points of the comparison, and its values and their sizes there."""


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
    source, heads = c_file.source_of(module), []
    for called, (function, points, _, _) in functions.items():
        example = {argument: x[:1] for argument, x in points.items()}
        heads.append(c_file.add_function(source, called, c_file.traced(what, function, example, module)))

    def compare(library: ctypes.CDLL) -> float:
        errors = []
        for called, (_, points, expected, of) in functions.items():
            values = c_file.answers(getattr(library, called), points, len(signals))
            errors.append(require_close(values, expected, of, c_file.TOLERANCE, signals, f"{called} in C"))
        return max(errors)

    return c_file.write_c(path, name, comment, [f"{head};" for head in heads], source, compare)


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
        c_file.NOTE,
        "A NaN in an observation gives NaN in every action that depends on it: check your sensors before.",
        "",
        *c_file.signal_table({"observation": plant.observations, "action": plant.actions}),
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
    name = f"{plant.name}_twin" if name is None else name
    path, plant, closure = c_file.require_names(path, name), frozen(plant), frozen(closure)
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
        c_file.NOTE,
        "A state that leaves the range of a table becomes NaN.",
        "",
        *c_file.signal_table({"state": plant.states, "command": plant.actions, "exogenous": plant.inputs}),
    ]
