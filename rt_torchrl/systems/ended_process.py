"""The end of a process that has been told to end."""

from typing import Any


def end_process(process: Any, within: float) -> None:
    """Wait until a process of ``multiprocessing`` has ended, and kill it if it does not.

    Args:
        process: the process, which knows that it is to end.
        within: longest time until it has ended [s].
    """
    process.join(within)
    if process.is_alive():
        process.kill()
        process.join()
