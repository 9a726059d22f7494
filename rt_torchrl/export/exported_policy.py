"""An exported policy read back, so that it acts without the module that it was made of."""

import ctypes
import re
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.export.agreement import sample_observations
from rt_torchrl.export.c_compiler import COMPILERS, c_array, called, compile_c, compiler
from rt_torchrl.export.onnx_model import require_packages, runtime
from rt_torchrl.plants.plant import Plant

KINDS = (".pt2", ".onnx", ".c")
WITH_CODE = (".pt2", ".c")
"""Kinds of files that run code of their own."""
DECLARED = re.compile(r"^void (\w+)\(const double \*observation, double \*action\);", re.MULTILINE)
"""The function in the header of :func:`export_c`."""


class ExportedPolicy(nn.Module):
    """A policy from a file, a function of the observation.

    Args:
        function: function of a batch of observations.
    """

    def __init__(self, function: Callable[[Tensor], Tensor]):
        super().__init__()
        self._function = function

    @torch.no_grad()
    def forward(self, observation: Float[Tensor, "*batch n_o"]) -> Float[Tensor, "*batch n_a"]:
        rows = observation.reshape(-1, observation.shape[-1])
        return self._function(rows).reshape(*observation.shape[:-1], -1)


def load_policy(path: Path | str, plant: Plant, *, trusted: bool = False) -> ExportedPolicy:
    """The policy in a file that :func:`export_program`, :func:`export_onnx` or :func:`export_c` has written.

    Two kinds of files run code of their own here, as a program does: a PyTorch program (.pt2) may hold pickled objects,
    which ``torch.export.load`` builds by whatever code they name, before anything is checked; a C file is compiled and
    called. An ONNX model (.onnx) does not: it holds nothing but operators of its run-time system.

    Args:
        path: file that ends in .pt2, .onnx or .c; a C file has its header beside it.
        plant: plant with the policy's observations and actions.
        trusted: whether a .pt2 or .c file may run its code, because you know who has written it.

    Raises:
        ValueError: if there is no such file, it is of another kind or damaged, it runs code and is not trusted, it
            needs a package or compiler that is not there, or it takes other observations or returns other actions than
            those of the plant.
    """
    file = Path(path)
    if file.suffix not in KINDS or not file.is_file():
        raise ValueError(f"policy={str(path)!r} must be a file that ends in {', '.join(KINDS)}; see recipes/export.py.")
    if file.suffix in WITH_CODE and not trusted:
        raise ValueError(
            f"policy={str(path)!r} is code that would run here: a .pt2 file may hold pickled objects, C is compiled "
            "and called. If you know who has written it, give trusted=True (--trusted of a recipe); an ONNX model "
            "needs no trust."
        )
    load = {".pt2": _program, ".onnx": _onnx, ".c": _c}[file.suffix]
    policy = ExportedPolicy(load(file, plant))
    seen = sample_observations(plant.observations, 1)
    try:
        found = policy(seen)
    except Exception as error:  # each runtime has errors of its own
        names = [signal.name for signal in plant.observations]
        raise ValueError(
            f"policy={str(path)!r} does not take the observations {names}: {str(error).strip()} Give what it observes."
        ) from error
    if found.shape[-1] != len(plant.actions) or not found.isfinite().all():
        names = [signal.name for signal in plant.actions]
        raise ValueError(f"policy={str(path)!r} answers {found.tolist()} instead of the actions {names}.")
    return policy


def _program(file: Path, plant: Plant) -> Callable[[Tensor], Tensor]:
    try:
        module = torch.export.load(str(file)).module()
    except Exception as error:  # torch.export raises many kinds
        raise ValueError(f"policy={str(file)!r} is no PyTorch program: {error}") from error
    return lambda rows: module(rows)


def _onnx(file: Path, plant: Plant) -> Callable[[Tensor], Tensor]:
    require_packages(["onnxruntime"])
    return runtime(file.read_bytes(), str(file))


def _c(file: Path, plant: Plant) -> Callable[[Tensor], Tensor]:
    found = compiler()
    if found is None:
        raise ValueError(f"policy={str(file)!r} needs a C compiler ({', '.join(COMPILERS)}), and there is none here.")
    name = _function_of(file, plant)
    with tempfile.TemporaryDirectory() as folder:
        for source in (file.with_suffix(".h"), file):
            (Path(folder) / source.name).write_bytes(source.read_bytes())
        library = ctypes.CDLL(str(compile_c(found, Path(folder) / file.name)))
    try:
        function = getattr(library, name)
    except AttributeError as error:
        raise ValueError(
            f"policy={str(file)!r} defines no function {name}; it is not the file of its header."
        ) from error
    return lambda rows: torch.stack([called(function, [c_array(row)], len(plant.actions)) for row in rows.tolist()])


def _function_of(file: Path, plant: Plant) -> str:
    """The name of the policy's function by its header, which must have the plant's numbers of signals."""
    header = file.with_suffix(".h")
    text = header.read_text(encoding="utf-8", errors="replace") if header.is_file() else ""
    declared = DECLARED.search(text)
    name = declared[1] if declared else ""
    signals = {
        what: re.search(rf"^#define {name.upper()}_{what} (\d+)$", text, re.MULTILINE)
        for what in ("OBSERVATIONS", "ACTIONS")
    }
    takes, returns = (int(number[1]) if number else 0 for number in signals.values())
    if not (takes and returns):
        raise ValueError(
            f"policy={str(file)!r}: its header {header.name} is not beside it, or does not declare a policy as "
            "export_c does; keep both files together."
        )
    if takes != len(plant.observations):
        raise ValueError(
            f"policy={str(file)!r} takes {takes} observations, and here are {len(plant.observations)}: it does not "
            f"take the observations {[signal.name for signal in plant.observations]}. Give what it observes."
        )
    if returns != len(plant.actions):
        raise ValueError(
            f"policy={str(file)!r} returns {returns} actions, and here are {len(plant.actions)}: "
            f"{[signal.name for signal in plant.actions]}. Give the plant that it acts on."
        )
    return name
