"""Places in the caller's code, for messages."""

import linecache
import sys
from traceback import walk_stack
from types import CodeType, ModuleType

import jaxtyping
import torch

GENERATED = ("<@beartype", "<string>")
"""Code that checks annotations at run time."""


class Places:
    """The lines of the caller's code whose operators are executed.

    An operator of a backward pass has no line of its own; it has the line of the operator that it is the gradient of,
    whose number in the order of the tape it shares.
    """

    def __init__(self) -> None:
        self._own = (*map(_folder, (torch, sys.modules[__package__], jaxtyping)), *GENERATED)
        self._noted: dict[int, tuple[CodeType, int]] = {}

    def note(self) -> None:
        """Note the line of an operator of a forward pass."""
        if not torch.is_grad_enabled():
            return
        number, found = torch._C._autograd._get_sequence_nr() - 1, self._innermost()
        if found is not None and number not in self._noted:  # operators without a gradient draw no number
            self._noted[number] = found

    def now(self) -> str:
        """The line of the operator that is executed now, as the end of a message."""
        node = torch._C._current_autograd_node()
        found = self._noted.get(node._sequence_nr()) if node is not None else None
        code, line = found or self._innermost() or (None, 0)
        if code is None:
            return ""
        text = linecache.getline(code.co_filename, line).strip()
        return f" (in {code.co_name}, {code.co_filename}:{line}: {text})"

    def _innermost(self) -> tuple[CodeType, int] | None:
        """The innermost line outside of torch, this room and the checks of annotations."""
        frames = walk_stack(sys._getframe(1))
        return next(((f.f_code, line) for f, line in frames if not f.f_code.co_filename.startswith(self._own)), None)


def _folder(module: ModuleType) -> str:
    return str(module.__file__).removesuffix("__init__.py")
