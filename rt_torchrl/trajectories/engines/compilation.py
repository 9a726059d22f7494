"""The choice between compiled and eager functions, and the settings of the compiler.

PyTorch's compiler takes seconds to load. The functions below import it, so that a command line need not.
"""

import shutil
import sysconfig
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

LIMITS = {
    # One graph per plant, policy and shape; the default of 8 is for loops that recompile by mistake.
    "recompile_limit": 256,
    "accumulated_recompile_limit": 4096,
    # The dt of a second plant would otherwise become a symbol, which a scan cannot capture.
    "specialize_float": True,
}
"""Settings of the tracer."""
OF_LIBRARIES = r".*torch\.jit\.script.*is deprecated"
"""A warning that code of PyTorch and TorchRL themselves causes, with new versions of PyTorch."""


@contextmanager
def without_warnings_of_libraries() -> Iterator[None]:
    """A context without the warnings that concern the libraries' own code, which a user cannot mend."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=OF_LIBRARIES, category=FutureWarning)
        yield


def raised_limits() -> AbstractContextManager[None]:
    """A context in which the tracer has the settings that this library compiles under."""
    return torch._dynamo.config.patch(LIMITS)


def compiled_if(
    compiled: bool, function: Callable[..., Any], eager: Callable[..., Any] | None = None
) -> Callable[..., Any]:
    """``torch.compile(function)`` if ``compiled``, otherwise ``eager`` (by default ``function`` itself).

    Raises:
        RuntimeError: if ``compiled`` and this machine has no compiler; the message says what to install.
    """
    if not compiled:
        return function if eager is None else eager
    missing = missing_for_compilation()
    if missing:
        raise RuntimeError(
            f"compiled=True needs {missing}, which this machine lacks. Install it (Debian: apt-get install g++ "
            "python3-dev) or choose compiled=False; a recipe takes --compiled False."
        )
    return _compile(function)


def marked_dynamic(tensor: Tensor, dim: int) -> Tensor:
    """Tell the compiler that a dimension of the tensor changes its size, so that one graph serves all sizes."""
    torch._dynamo.maybe_mark_dynamic(tensor, dim)
    return tensor


def plain(tensor: Tensor) -> Tensor:
    """A copy with the strides of its shape.

    A tensor with a dimension of size one counts as contiguous whatever its stride in that dimension. The compiler
    nevertheless traces again for another stride, and a scan refuses it.
    """
    return tensor.clone(memory_format=torch.contiguous_format)


def missing_for_compilation() -> str | None:
    """The name of what torch.compile lacks on this machine's CPU; None if it lacks nothing."""
    from torch._inductor import config as inductor_config

    candidates = [c for c in inductor_config.cpp.cxx if c] if isinstance(inductor_config.cpp.cxx, tuple) else ["g++"]
    if not any(shutil.which(str(candidate)) for candidate in candidates):
        return "a C++ compiler"
    if not (Path(sysconfig.get_paths()["include"]) / "Python.h").exists():
        return "the headers of Python"
    return None


@contextmanager
def watched_compilation(tell: Callable[[bool], None]) -> Iterator[None]:
    """A context that calls ``tell(True)`` when the compiler begins and ``tell(False)`` when it ends."""
    from torch._dynamo.callback import callback_handler

    begun = callback_handler.register_start_callback(lambda arguments: tell(True))
    ended = callback_handler.register_end_callback(lambda arguments: tell(False))
    try:
        yield
    finally:
        callback_handler.remove_start_callback(begun)
        callback_handler.remove_end_callback(ended)


@cache
def _compile(function: Callable[..., Any]) -> Callable[..., Any]:
    # Cached, so that every user of a function shares its graphs.
    _prepare()
    return torch.compile(function, fullgraph=True, options={"guard_filter_fn": _lasting})


def _lasting(guards: Sequence[Any]) -> list[bool]:
    """Leave out the one guard that fails again and again although nothing has changed.

    TensorDict takes part in every vmap and remembers there which classes are its own. This memory grows as a program
    goes on, and each time the compiler would trace every graph with a vmap in it once more.
    """
    return ["_TENSORCLASS_MEMO" not in guard.name for guard in guards]


@cache
def _prepare() -> None:
    from hoptorch.scan import ensure_scan_backward

    # The scan's backward must have been probed before it is traced.
    ensure_scan_backward("cuda" if torch.cuda.is_available() else "cpu")
    for name, value in LIMITS.items():
        setattr(torch._dynamo.config, name, value)
