"""Fingerprints of modules: equal where the traced programs are equal."""

import hashlib
import io
import pickle
import types
from typing import Any

import torch
from torch import Tensor, nn


def fingerprint(module: nn.Module) -> tuple[bytes, tuple[object, ...]]:
    """A digest of everything in a module but the values of its parameters, which a program takes when it runs.

    Constants and buffers become a part of a program. A module with another constant has another fingerprint, so that
    it is traced anew.

    Returns:
        the digest, and objects that the digest knows by their address; whoever keeps the digest keeps them alive.
    """
    text = io.BytesIO()
    pickler = _Pickler(text)
    pickler.dump(module)
    return hashlib.sha256(text.getvalue()).digest(), tuple(pickler.alive)


class _Pickler(pickle.Pickler):
    """Pickles a module with short names for what is large, shared or cannot be pickled."""

    def __init__(self, file: io.BytesIO):
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self.alive: list[object] = []

    def persistent_id(self, obj: Any) -> Any:
        if isinstance(obj, nn.Parameter):
            return "parameter", tuple(obj.shape), str(obj.dtype), obj.requires_grad
        if isinstance(obj, Tensor):
            content = obj.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
            return "tensor", tuple(obj.shape), str(obj.dtype), hashlib.sha256(content).digest()
        if isinstance(obj, (type, types.FunctionType, types.BuiltinFunctionType, types.ModuleType)):
            return self._by_address(obj)
        return None

    def reducer_override(self, obj: Any) -> Any:
        try:
            obj.__reduce_ex__(pickle.HIGHEST_PROTOCOL)
        except (TypeError, pickle.PicklingError):
            return _Known, self._by_address(obj)
        return NotImplemented

    def _by_address(self, obj: object) -> tuple[str, int]:
        self.alive.append(obj)
        return type(obj).__name__, id(obj)


class _Known(tuple[str, int]):
    """Stands for an object that is known by its address."""
