"""Devices and compilation on this machine, and the libraries' log lines."""

import logging
import os
import warnings

import torch

from rt_torchrl.trajectories.engines.parallel import OF_LIBRARIES, missing_for_compilation

NOISY = ("torchrl", "torch.utils.cpp_extension")
"""Loggers that report the inner work of a library."""


def quieten_libraries() -> None:
    """Keep log lines and warnings off the terminal that concern the libraries' own code, which a user cannot mend."""
    os.environ.setdefault("RL_LOGGING_LEVEL", "ERROR")  # TorchRL sets its own level when it is loaded, which is later
    for name in NOISY:
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", message=OF_LIBRARIES, category=FutureWarning)


def require_device(name: str) -> torch.device:
    """The device of this name.

    Raises:
        ValueError: if this machine has no such device.
    """
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device={name!r} cannot be used on this machine ({error}); use cpu.") from error
    return device


def can_compile(device: torch.device) -> bool:
    """Whether this machine has what torch.compile needs; if not, the terminal shows what is missing."""
    missing = missing_for_compilation() if device.type == "cpu" else None
    if missing:
        print(f"This machine lacks {missing}: running without torch.compile, several times slower.")
    return missing is None
