"""Ctrl-C between two iterations: what is under way in one is never left half done."""

import os
import signal
import threading
from types import FrameType

NOTICE = b"\ninterrupted: the training stops after the iteration under way (Ctrl-C again to leave at once)\n"


class Interruption:
    """While it is entered, Ctrl-C takes effect at the next :func:`safe_point`, and the second Ctrl-C at once.

    A KeyboardInterrupt that is raised anywhere can hit torch or TorchRL while they have swapped weights, switched
    gradients off or hold a lock; they then fail in other ways, or stay so.

    Note: a thread that is not the main one gets no Ctrl-C, and an own handler of SIGINT stays in charge; there it does
    nothing.

    ``at_once`` tells whether there was a second one.
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
    """To be called between two iterations of whatever takes long.

    Raises:
        KeyboardInterrupt: if Ctrl-C was pressed since the :class:`Interruption` was entered.
    """
    if Interruption._asked:
        raise KeyboardInterrupt
