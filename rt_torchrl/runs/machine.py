"""What this machine can run."""

import logging
import warnings

import torch

from rt_torchrl.trajectories.engines.compilation import missing_for_compilation

NOISY = ("torchrl", "torch.utils.cpp_extension")
"""Loggers that report how a library works inside."""


def quieten_libraries() -> None:
    """Keep off the terminal what libraries say of themselves, of which nothing is the user's to mend."""
    for name in NOISY:
        logging.getLogger(name).setLevel(logging.ERROR)
    # Of the code of PyTorch and TorchRL themselves, and only with new versions of PyTorch.
    warnings.filterwarnings("ignore", message=r".*torch\.jit\.script.*is deprecated", category=FutureWarning)


def require_device(name: str) -> torch.device:
    """The device of that name.

    Raises:
        ValueError: if there is no such device on this machine.
    """
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device={name!r} cannot be used on this machine ({error}); use cpu.") from error
    return device


def can_compile(device: torch.device) -> bool:
    """Whether this machine has what torch.compile needs; if not, says on the terminal what is missing."""
    missing = missing_for_compilation() if device.type == "cpu" else None
    if missing:
        print(f"This machine lacks {missing}: running without torch.compile, several times slower.")
    return missing is None
