"""What a program says before it imports PyTorch, which takes seconds, and packages that only some programs need."""

import importlib
import os
import sys
from types import ModuleType


def begin_loading(module: str) -> None:
    """Say at once what a program is doing, and let threads of PyTorch that have nothing to do wait without a core.

    By default they wait actively: beside other programs, a training with two threads took three times as long as with
    this. The environment variable OMP_WAIT_POLICY, where it is set, decides.

    Args:
        module: ``__name__`` of the module that calls this; nothing is done for one that is imported.
    """
    if module != "__main__":
        return
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
