"""Ctrl-C takes effect between two iterations, so that no iteration is left half done."""

import os
import signal
import threading
from types import FrameType

NOTICE = b"\ninterrupted: the training stops after the iteration under way (Ctrl-C again to leave at once)\n"


class Interruption:
    """A context in which Ctrl-C takes effect at the next :func:`safe_point`, and a second Ctrl-C at once.

    A KeyboardInterrupt at any other place can hit torch or TorchRL while they have swapped weights, switched gradients
    off or hold a lock. They then fail in other ways, or remain in that state.

    Note: only the main thread receives Ctrl-C, and a handler of SIGINT that the user has installed stays in charge.
    The context does nothing in another thread or beside such a handler.

    The attribute ``at_once`` tells whether there was a second Ctrl-C.
    """

    _asked = False

    def __enter__(self) -> "Interruption":
        Interruption._asked = self.at_once = False
        main = threading.current_thread() is threading.main_thread()
        self._installed = main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if self._installed:
            signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *error: object) -> None:
        Interruption._asked = False
        if self._installed:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if Interruption._asked:
            self.at_once = True
            signal.default_int_handler(number, frame)
        Interruption._asked = True
        # print() must not be called here: it may be what was interrupted.
        os.write(2, NOTICE)


def safe_point() -> None:
    """Stop here if Ctrl-C was pressed; long computations call this function between two iterations.

    Raises:
        KeyboardInterrupt: if Ctrl-C was pressed since the :class:`Interruption` was entered.
    """
    if Interruption._asked:
        raise KeyboardInterrupt
