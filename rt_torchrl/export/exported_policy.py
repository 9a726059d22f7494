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
from rt_torchrl.export.c_file import COMPILERS, answers, compile_c, compiler
from rt_torchrl.export.program import onnx_runtime
from rt_torchrl.plants.plant import Plant

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
    file, kinds = Path(path), {".pt2": _program, ".onnx": _onnx, ".c": _c}
    observations, actions = ([signal.name for signal in signals] for signals in (plant.observations, plant.actions))
    if file.suffix not in kinds or not file.is_file():
        raise ValueError(f"policy={str(path)!r} must be a file that ends in {', '.join(kinds)}; see recipes/export.py.")
    if file.suffix in WITH_CODE and not trusted:
        raise ValueError(
            f"policy={str(path)!r} is code that would run here: a .pt2 file may hold pickled objects, C is compiled "
            "and called. If you know who has written it, give trusted=True (--trusted of a recipe); an ONNX model "
            "needs no trust."
        )
    policy = ExportedPolicy(kinds[file.suffix](file, plant))
    try:
        answer = policy(sample_observations(plant.observations, 1))
    except Exception as error:  # each runtime has errors of its own
        raise ValueError(
            f"policy={str(path)!r} does not take the observations {observations}: {str(error).strip()} Give what it "
            "observes."
        ) from error
    if answer.shape[-1] != len(actions) or not answer.isfinite().all():
        raise ValueError(f"policy={str(path)!r} answers {answer.tolist()} instead of the actions {actions}.")
    return policy


def _program(file: Path, plant: Plant) -> Callable[[Tensor], Tensor]:
    try:
        return torch.export.load(str(file)).module()
    except Exception as error:  # torch.export raises many kinds
        raise ValueError(f"policy={str(file)!r} is no PyTorch program: {error}") from error


def _onnx(file: Path, plant: Plant) -> Callable[[Tensor], Tensor]:
    return onnx_runtime(file.read_bytes(), str(file))


def _c(file: Path, plant: Plant) -> Callable[[Tensor], Tensor]:
    found, header = compiler(), file.with_suffix(".h")
    if found is None:
        raise ValueError(f"policy={str(file)!r} needs a C compiler ({', '.join(COMPILERS)}), and there is none here.")
    text = header.read_text(encoding="utf-8", errors="replace") if header.is_file() else ""
    declared = DECLARED.search(text)
    name = declared[1] if declared else ""
    expected = {"OBSERVATIONS": plant.observations, "ACTIONS": plant.actions}
    numbers = {what: re.search(rf"^#define {name.upper()}_{what} (\d+)$", text, re.MULTILINE) for what in expected}
    for what, signals in expected.items():
        number = numbers[what]
        if number is None:
            raise ValueError(
                f"policy={str(file)!r}: its header {header.name} is not beside it, or does not declare a policy as "
                "export_c does; keep both files together."
            )
        if int(number[1]) != len(signals):
            raise ValueError(
                f"policy={str(file)!r} has {number[1]} {what.lower()}, and here are {len(signals)}: it does not go "
                f"with {[signal.name for signal in signals]}. Give the plant that it was made for."
            )
    with tempfile.TemporaryDirectory() as folder:
        for source in (header, file):
            Path(folder, source.name).write_bytes(source.read_bytes())
        function = getattr(ctypes.CDLL(str(compile_c(found, Path(folder, file.name)))), name, None)
    if function is None:
        raise ValueError(f"policy={str(file)!r} defines no function {name}; it is not the file of its header.")
    return lambda rows: answers(function, {"observation": rows}, len(plant.actions))
