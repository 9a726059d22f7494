"""Escapes: methods by which numbers leave torch, where a tracer cannot follow them."""

from typing import Any

from torch import Tensor
from torch.overrides import TorchFunctionMode

from rt_torchrl.programs.tracer import Arguments, Options, Tracer

ESCAPES = {
    getattr(Tensor, name): name
    for name in ("numpy", "tolist", "__array__", "data_ptr", "__dlpack__", "untyped_storage")
}


class Escapes(TorchFunctionMode):
    """Refuses such methods for tensors whose numbers are not known when the program is made.

    Args:
        tracer: the tracer that knows them.
    """

    def __init__(self, tracer: Tracer):
        super().__init__()
        self._tracer = tracer

    def __torch_function__(self, func: Any, types: Any, args: Arguments = (), kwargs: Options | None = None) -> Any:
        if func in ESCAPES:
            self._tracer.require_known(f".{ESCAPES[func]}() takes a number from a tensor that varies", args)
        return func(*args, **(kwargs or {}))
