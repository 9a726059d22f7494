"""The policy as a PyTorch program: a file that torch alone can load."""

import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.export import Dim, ExportedProgram

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.export.agreement import detached, require_agreement, sample_observations
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

INTERFACE = "interface.json"
"""Name of the extra file of a program that describes its observations and actions."""


def trace(policy: nn.Module, plant: Plant) -> ExportedProgram:
    """The graph of a policy for any number of observations, ``(batch, n_o) -> (batch, n_a)``.

    Args:
        policy: policy from :func:`detached`.
        plant: plant with the policy's observations.

    Raises:
        ValueError: if torch.export cannot trace the policy, or the policy draws random numbers.
    """
    name, observations = type(policy).__name__, sample_observations(plant.observations, 3)
    try:
        program = torch.export.export(policy, (observations,), dynamic_shapes=({0: Dim("batch")},))
        # This takes no operator apart, but removes those that do nothing in evaluation, such as dropout.
        program = program.run_decompositions({})
    except Exception as error:  # torch.export raises many kinds, of several modules
        raise ValueError(
            f"policy {name} cannot be traced by torch.export: {str(error).strip()} Write branches on values as "
            "torch.where, and sizes such that any batch can be passed."
        ) from error
    for node in program.graph.nodes:
        if torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ()):
            raise ValueError(f"{layer_of(node, name)} draws random numbers ({node.target}); export its mean instead.")
    return program


def layer_of(node: torch.fx.Node, policy: str) -> str:
    """The module that a node of a graph comes from, in words."""
    stack = list((node.meta.get("nn_module_stack") or {}).values())
    path, kind = stack[-1] if stack else ("", policy)
    kind = kind if isinstance(kind, str) else kind.__name__
    return f"layer {path!r} ({kind.rpartition('.')[2]}) of policy {policy}" if path else f"policy {policy}"


def interface(plant: Plant) -> dict[str, Any]:
    """The description of a policy's observations and actions, as JSON can hold it; an absent bound is None.

    An observation that is a scaled measurement is (measurement − offset)/scale, both in the unit ``measured_in``.
    """

    def described(signals: Sequence[Signal]) -> list[dict[str, Any]]:
        return [{"name": s.name, "unit": s.unit, "low": finite(s.low), "high": finite(s.high)} for s in signals]

    def finite(bound: float) -> float | None:
        return bound if math.isfinite(bound) else None

    scaled = [{"offset": m.offset, "scale": m.scale, "measured_in": m.unit} for m in plant.observed]
    observed = scaled or [{} for _ in plant.observations]
    return {
        "plant": plant.name,
        "control_interval_s": plant.dt,
        "observation": [one | more for one, more in zip(described(plant.observations), observed, strict=True)],
        "action": described(plant.actions),
    }


def export_program(policy: nn.Module, path: Path | str, plant: Plant) -> float:
    """Write a policy as a program of torch.export, (batch, n_o) -> (batch, n_a) in double precision.

    A program runs without this library. Its extra file ``interface.json`` describes observations and actions. Who loads
    it must trust where it comes from, because ``torch.export.load`` runs the code of objects that are pickled in it::

        policy = torch.export.load("policy.pt2").module()
        action = policy(observation)

    Args:
        policy: any ``policy(observation) -> action`` in double precision.
        path: file to write, such as ``policy.pt2``.
        plant: plant with the policy's observations and actions.

    Returns:
        Greatest difference from the policy, see :func:`require_agreement`.

    Raises:
        ValueError: if the policy does not fit the plant or cannot be traced, or the program does not agree with it.
    """
    policy = detached(policy, plant)
    file = io.BytesIO()
    torch.export.save(trace(policy, plant), file, extra_files={INTERFACE: json.dumps(interface(plant), indent=2)})
    loaded = torch.export.load(io.BytesIO(file.getvalue())).module()
    error = require_agreement(policy, loaded, plant, what="the exported program")
    write_atomically(Path(path), file.getvalue())
    return error
