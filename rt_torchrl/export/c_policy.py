"""A policy as a C99 file and its header, which need nothing but the mathematics of the C library."""

import ctypes
from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.export.agreement import detached, require_agreement, sample_observations
from rt_torchrl.export.c_compiler import c_array, called
from rt_torchrl.export.c_file import CFile, signal_table
from rt_torchrl.export.traced_function import frozen, traced, weights_of
from rt_torchrl.plants.plant import Plant
from rt_torchrl.programs.c_source import CSource

EXAMPLES = 3
"""Number of observations with their actions in the header, to test the function on its target machine."""


def export_c(policy: nn.Module, path: Path | str, plant: Plant, *, function: str | None = None) -> float | None:
    """Write a policy as C99: one function ``void <function>(const double *observation, double *action)``.

    The function holds weights, normalisation and saturation. It allocates nothing, keeps nothing between calls and
    needs only ``math.h``. The header describes observations and actions, with units and ranges, and gives examples.
    :func:`export_controller` also writes what makes the observation of measured signals.

    The check compiles the file and calls the function. If there is no compiler, a warning says that the check was left
    out.

    Args:
        policy: any ``policy(observation) -> action`` in double precision that can be traced to arithmetic.
        path: file to write, such as ``policy.c``; the header gets the same name with ``.h``.
        plant: plant with the policy's observations and actions.
        function: name of the function; by default the name of the plant with ``_policy``.

    Returns:
        Greatest difference from the policy, see :func:`require_agreement`; None without a check.

    Raises:
        ValueError: if the path or the name does not fit, the policy does not fit the plant or cannot be traced (the
            message names the line), the file does not compile, or the function does not agree with the policy.
    """
    function = f"{plant.name}_policy" if function is None else function
    file = CFile(path, function)
    policy = frozen(detached(policy, plant))
    head = f"void {function}(const double *observation, double *action)"
    source = _source(policy, plant, head)

    def compare(library: ctypes.CDLL) -> float:
        return require_agreement(policy, _each(library, function, len(plant.actions)), plant, what="the C function")

    macros = [
        f"#define {function.upper()}_OBSERVATIONS {len(plant.observations)}",
        f"#define {function.upper()}_ACTIONS {len(plant.actions)}",
    ]
    return file.write(_comment(policy, plant, function), [*macros, "", f"{head};"], source, compare)


def _source(policy: nn.Module, plant: Plant, head: str) -> CSource:
    found = traced(
        f"policy {type(policy).__name__}",
        lambda observation: {"action": policy(observation)},
        {"observation": sample_observations(plant.observations, 1)},
        [policy],
    )
    source = CSource(weights_of({"policy": policy}))
    inputs = {("observation", k): f"observation[{k}]" for k in range(len(plant.observations))}
    source.add(head, found.program, inputs, [(f"action[{k}]", v) for k, v in enumerate(found.outputs["action"])])
    return source


def _each(
    library: ctypes.CDLL, function: str, n_actions: int
) -> Callable[[Float[Tensor, "n n_o"]], Float[Tensor, "n n_a"]]:
    """The compiled function, applied to every row of observations."""
    compiled = getattr(library, function)
    return lambda observations: torch.stack([called(compiled, [c_array(o)], n_actions) for o in observations.tolist()])


def _comment(policy: nn.Module, plant: Plant, function: str) -> list[str]:
    kind = type(plant)
    return [
        f"{function}: a policy of the plant {plant.name} ({type(policy).__name__}), written by rt_torchrl.",
        "",
        f"Call it once every {plant.dt:g} s, the plant's control interval, and hold the action in between.",
        "It has no memory, allocates nothing, may be called from several threads, and needs only math.h.",
        "A NaN in an observation gives NaN in every action that depends on it: check your sensors before.",
        "",
        *signal_table({"observation": plant.observations, "action": plant.actions}),
        *(f"observation[{k}] is {m.scaling}." for k, m in enumerate(plant.observed) if m.scaling),
        "",
        f"Observations are made of states and inputs by {kind.__name__}.observe, in {kind.__module__}.",
        "A range of observations is where they usually lie; actions never leave theirs, if the policy saturates.",
        "",
        "Examples, to try it on the machine it is meant for:",
        *_examples(policy, plant),
    ]


def _examples(policy: nn.Module, plant: Plant) -> list[str]:
    observations = sample_observations(plant.observations, EXAMPLES)

    def row(values: Tensor) -> str:
        return "{" + ", ".join(f"{value:.9g}" for value in values.tolist()) + "}"

    # The actions are those of the rounded observations, so that the printed numbers are what goes in.
    observations = torch.tensor(
        [[float(f"{v:.9g}") for v in row_] for row_ in observations.tolist()], dtype=torch.float64
    )
    return [f"{row(o)} -> {row(a)}" for o, a in zip(observations, policy(observations), strict=True)]
