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


def load_policy(path: Path | str, plant: Plant) -> ExportedPolicy:
    """The policy in a file that :func:`export_program`, :func:`export_onnx` or :func:`export_c` has written.

    A C file is compiled and called: its code runs here, so that the file must be trusted as a program is.

    Args:
        path: file that ends in .pt2, .onnx or .c; a C file has its header beside it.
        plant: plant with the policy's observations and actions.

    Raises:
        ValueError: if there is no such file, it is of another kind or damaged, it needs a package or compiler that is
            not there, or it takes other observations or returns other actions than those of the plant.
    """
    file = Path(path)
    if file.suffix not in KINDS or not file.is_file():
        raise ValueError(f"policy={str(path)!r} must be a file that ends in {', '.join(KINDS)}; see recipes/export.py.")
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
    require_packages()
    return runtime(file.read_bytes(), str(file))


def _c(file: Path, plant: Plant) -> Callable[[Tensor], Tensor]:
    found = compiler()
    if found is None:
        raise ValueError(f"policy={str(file)!r} needs a C compiler ({', '.join(COMPILERS)}), and there is none here.")
    with tempfile.TemporaryDirectory() as folder:
        for source in (file.with_suffix(".h"), file):
            if source.is_file():
                (Path(folder) / source.name).write_bytes(source.read_bytes())
        library = ctypes.CDLL(str(compile_c(found, Path(folder) / file.name)))
    try:
        function = getattr(library, file.stem)
    except AttributeError as error:
        raise ValueError(f"policy={str(file)!r} defines no function {file.stem}; keep the file's name.") from error
    n_o, n_a = len(plant.observations), len(plant.actions)
    takes = max((int(k) for k in re.findall(r"observation\[(\d+)\]", file.read_text(encoding="utf-8"))), default=-1) + 1
    if takes != n_o:
        raise ValueError(
            f"policy={str(file)!r} takes {takes} observations, and here are {n_o}: it does not take the observations "
            f"{[signal.name for signal in plant.observations]}. Give what it observes."
        )
    return lambda rows: torch.stack([called(function, [c_array(row)], n_a) for row in rows.tolist()])
