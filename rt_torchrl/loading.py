"""What a program says before it imports PyTorch, which takes seconds, and packages that only some programs need."""

import importlib
import os
import sys
from types import ModuleType


def begin_loading() -> None:
    """Say at once what the program is doing, and let threads of PyTorch that have nothing to do wait without a core.

    By default they wait actively: beside other programs, a training with two threads took three times as long as with
    this. The environment variable OMP_WAIT_POLICY, where it is set, decides.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    print("loading PyTorch and TorchRL", file=sys.stderr, flush=True)


def of_extra(module: str, extra: str) -> ModuleType:
    """A module of a package that an extra of this library installs.

    Raises:
        ValueError: if the package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ValueError(
            f"{error.name} is not installed: install the extra, pip install 'rt_torchrl[{extra}]'."
        ) from error
