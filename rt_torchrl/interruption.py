"""Ctrl-C and SIGTERM take effect between two iterations, so that no iteration is left half done."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

NOTICE = (
    b"\ninterrupted: a training stops after the iteration under way, a flight at once (once more to leave at once)\n"
)


SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a training: that of Ctrl-C, and that by which service managers and batch systems stop a process."""
UNTOUCHED = (signal.default_int_handler, signal.SIG_DFL)
"""Handlers of a signal for which nobody has installed one."""


class Interruption:
    """A context in which Ctrl-C or SIGTERM takes effect at the next :func:`safe_point`, and a second one at once.

    A KeyboardInterrupt at any other place can hit torch or TorchRL while they have swapped weights, switched gradients
    off or hold a lock. They then fail in other ways, or remain in that state.

    Note: only the main thread receives signals, and a handler that the user has installed stays in charge of its
    signal. The context does nothing in another thread.

    The attribute ``at_once`` tells whether there was a second signal.
    """

    _pending = False

    def __enter__(self) -> "Interruption":
        Interruption._pending = self.at_once = False
        self._before = {}
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if signal.getsignal(number) in UNTOUCHED:
                    self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        Interruption._pending = False
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self.at_once and error is not None and not isinstance(error, KeyboardInterrupt):
            # Torch and TorchRL may have turned the KeyboardInterrupt into another error.
            raise KeyboardInterrupt from error

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if Interruption._pending:
            self.at_once = True
            signal.default_int_handler(number, frame)
        Interruption._pending = True
        # print() must not be called here: it may be what was interrupted.
        os.write(2, NOTICE)


@contextlib.contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """A context in which SIGTERM raises KeyboardInterrupt, as Ctrl-C does; a handler that is there already stays."""
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def safe_point() -> None:
    """Stop here if an end was asked for; long computations call this function between two iterations.

    Raises:
        KeyboardInterrupt: if Ctrl-C or SIGTERM came since the :class:`Interruption` was entered.
    """
    if Interruption._pending:
        raise KeyboardInterrupt


class Interrupted(SystemExit):
    """The end of a program, in words, whose training Ctrl-C or SIGTERM has stopped; no other training must follow."""
