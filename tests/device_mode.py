"""A mode that fails where a tensor is made without a device."""

import sys
from pathlib import Path

import torch
from torch.overrides import TorchFunctionMode

ROOT = Path(__file__).resolve().parent.parent
WATCHED = tuple(str(ROOT / folder) + "/" for folder in ("rt_torchrl", "envs"))
FACTORIES = {
    torch.arange,
    torch.empty,
    torch.eye,
    torch.full,
    torch.from_numpy,
    torch.linspace,
    torch.logspace,
    torch.ones,
    torch.rand,
    torch.randint,
    torch.randn,
    torch.randperm,
    torch.scalar_tensor,
    torch.tensor,
    torch.zeros,
}
"""All that make a tensor from nothing; ``as_tensor`` leaves a tensor where it is, and is asked about numbers alone."""


class RequireDevice(TorchFunctionMode):
    """A mode that collects the places where code of this library makes a tensor without naming its device."""

    def __init__(self):
        super().__init__()
        self.found: dict[str, str] = {}

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        numbers = func is torch.as_tensor and not isinstance(args[0], torch.Tensor)
        if (func in FACTORIES or numbers) and kwargs.get("device") is None:
            frame = sys._getframe(1)
            if frame.f_code.co_filename.startswith(WATCHED):
                place = f"{Path(frame.f_code.co_filename).relative_to(ROOT)}:{frame.f_lineno}"
                self.found[place] = func.__name__
        return func(*args, **kwargs)
