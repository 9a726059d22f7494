"""The policy as an ONNX model, for the run-time systems of other languages and machines."""

import contextlib
import importlib
import json
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.export.agreement import detached, require_agreement
from rt_torchrl.export.program import INTERFACE, interface, trace
from rt_torchrl.plants.plant import Plant

NEEDED = ("onnx", "onnxscript", "onnxruntime")


def export_onnx(policy: nn.Module, path: Path | str, plant: Plant) -> float:
    """Write a policy as an ONNX model, input ``observation`` and output ``action``.

    Their shapes are (batch, n_o) and (batch, n_a) for any batch, in double precision. The model's metadata hold
    ``interface.json`` with names, units and ranges. The file contains the weights.

    Args:
        policy: any ``policy(observation) -> action`` in double precision.
        path: file to write, such as ``policy.onnx``.
        plant: plant with the policy's observations and actions.

    Returns:
        Greatest difference between the model in onnxruntime and the policy, see :func:`require_agreement`.

    Raises:
        ValueError: if a package of the extra ``onnx`` is missing, the policy does not fit the plant or has no ONNX
            form, onnxruntime cannot run the model, or the model does not agree with the policy.
    """
    require_packages()
    policy = detached(policy, plant)
    name = type(policy).__name__
    model = _converted(trace(policy, plant), name)
    entry = model.metadata_props.add()
    entry.key, entry.value = INTERFACE, json.dumps(interface(plant))
    difference = require_agreement(policy, runtime(model.SerializeToString(), name), plant, what="the ONNX model")
    write_atomically(Path(path), model.SerializeToString())
    return difference


def _converted(program: torch.export.ExportedProgram, name: str) -> Any:
    """The ONNX model of a traced policy of that name."""
    try:
        with _quiet():
            exported = torch.onnx.export(
                program,
                (),
                dynamo=True,
                verbose=False,
                input_names=["observation"],
                output_names=["action"],
                dynamic_shapes=({0: "batch"},),
            )
    except Exception as error:  # the exporter raises several kinds
        raise ValueError(
            f"policy {name} has no ONNX form: {str(error).strip()}. Use the .pt2 program or C instead."
        ) from error
    assert exported is not None  # the exporter of dynamo gives a program; only the older one gives none
    return exported.model_proto


def require_packages(needed: Sequence[str] | None = None) -> None:
    """Refuse to go on without packages of the extra ``onnx``.

    Args:
        needed: packages; by default all that an export needs.

    Raises:
        ValueError: if a package is not installed.
    """
    for package in NEEDED if needed is None else needed:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ValueError(
                f"ONNX needs the package {package}, which is not installed; pip install 'rt_torchrl[onnx]'."
            ) from error


def runtime(model: bytes, policy: str) -> Callable[[Tensor], Tensor]:
    """A model as a function of a batch of observations.

    Raises:
        ValueError: if onnxruntime cannot run the model.
    """
    import onnxruntime

    try:
        session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    except Exception as error:  # the errors of onnxruntime have no common class
        raise ValueError(
            f"onnxruntime cannot run policy {policy} in double precision: {str(error).strip()}. Use the .pt2 program "
            "or C instead."
        ) from error

    def run(observations: Tensor) -> Tensor:
        return torch.from_numpy(session.run(["action"], {"observation": observations.numpy()})[0])

    return run


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """A context without the exporter's notices, of a missing torchvision and of outdated functions in torch itself."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            yield
    finally:
        logger.setLevel(level)
