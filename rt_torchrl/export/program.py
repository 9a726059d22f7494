"""A policy as an ONNX model, for other run-time systems."""

import json
import logging
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.export.agreement import OBSERVATIONS, action_sizes, detached, require_close, sample_observations
from rt_torchrl.loading import of_extra
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

INTERFACE = "interface.json"
"""Name of the metadata of a model that describes observations and actions."""
TOLERANCE = 1e-6
"""Greatest difference of an action, as a share of its range; computation in double precision needs 1e-12."""


def export_onnx(policy: nn.Module, path: Path | str, plant: Plant) -> float:
    """Write a policy as an ONNX model, input ``observation`` and output ``action``.

    Their shapes are (batch, n_o) and (batch, n_a) for any batch, in double precision. The model's metadata hold
    ``interface.json`` with names, units and ranges. The file contains the weights.

    Args:
        policy: any ``policy(observation) -> action`` in double precision.
        path: file to write, such as ``policy.onnx``.
        plant: plant with the policy's observations and actions.

    Returns:
        Greatest difference between the model in onnxruntime and the policy, as a share of the range of an action.

    Raises:
        ValueError: if a package of the extra ``export`` is missing, the policy does not fit the plant or has no ONNX
            form, onnxruntime cannot run the model, or the model does not agree with the policy.
    """
    onnxruntime = [of_extra(package, "export") for package in ("onnx", "onnxscript", "onnxruntime")][-1]
    policy, name = detached(policy, plant), type(policy).__name__
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns of a missing torchvision
    options: dict[str, Any] = {"input_names": ["observation"], "output_names": ["action"]}
    try:
        program = torch.export.export(
            policy, (sample_observations(plant.observations, 3),), dynamic_shapes=({0: Dim("batch")},)
        ).run_decompositions({})  # which takes no operator apart, but removes those that do nothing, such as dropout
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            exported = torch.onnx.export(
                program, (), dynamo=True, verbose=False, dynamic_shapes=({0: "batch"},), **options
            )
        assert exported is not None  # the exporter of dynamo gives a program; only the older one gives none
        model = exported.model_proto
        entry = model.metadata_props.add()
        entry.key, entry.value = INTERFACE, json.dumps(interface(plant))
        content = model.SerializeToString()
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    except Exception as error:  # torch.export, its exporter and onnxruntime raise many kinds, of several modules
        raise ValueError(
            f"policy {name} has no ONNX form that onnxruntime runs in double precision: "
            f"{str(error).strip()}. Write branches on values as torch.where, and sizes so that any batch can be "
            "passed, or use C."
        ) from error

    def run(rows: Tensor) -> Tensor:
        return torch.from_numpy(session.run(["action"], {"observation": rows.numpy()})[0])

    observations, what = sample_observations(plant.observations, OBSERVATIONS), f"the ONNX model of policy {name}"
    expected = policy(observations)
    if not expected.isfinite().all():
        raise ValueError(f"{what} gives actions that are not finite.")
    actions = torch.cat([run(part) for part in observations.split([1, 2, OBSERVATIONS - 3])])  # any batch
    difference = require_close(actions, expected, action_sizes(plant, expected), TOLERANCE, plant.actions, what)
    write_atomically(Path(path), content)
    return difference


def interface(plant: Plant) -> dict[str, Any]:
    """The description of a policy's observations and actions, as JSON can hold it; an absent bound is None.

    An observation that is a scaled measurement is (measurement − offset)/scale, both in the unit ``measured_in``.
    """

    def described(signals: Sequence[Signal]) -> list[dict[str, Any]]:
        return [
            {"name": s.name, "unit": s.unit}
            | {end: x if math.isfinite(x) else None for end, x in (("low", s.low), ("high", s.high))}
            for s in signals
        ]

    scaled = [{"offset": m.offset, "scale": m.scale, "measured_in": m.unit} for m in plant.observed]
    observed = scaled or [{} for _ in plant.observations]
    return {
        "plant": plant.name,
        "control_interval_s": plant.dt,
        "observation": [signal | more for signal, more in zip(described(plant.observations), observed, strict=True)],
        "action": described(plant.actions),
    }
