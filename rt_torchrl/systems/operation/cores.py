"""CPU cores of the acting process and of the learner, where the operating system lets a process choose them."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

LAST, ANY = -1, -2
"""Values of a core: the last one that this process may use, and any."""

PRIORITY = 10
"""Priority of real-time scheduling; below that of the kernel's own threads."""


def chosen_core(core: int) -> int | None:
    """The core that the acting process has for itself; None if it has none.

    Args:
        core: number of a core, ``LAST`` or ``ANY``.

    Raises:
        ValueError: if this process may not use the core.
    """
    if core == ANY or not hasattr(os, "sched_getaffinity"):
        return None
    allowed = sorted(os.sched_getaffinity(0))
    if core == LAST:
        return allowed[-1] if len(allowed) > 1 else None
    if core not in allowed:
        raise ValueError(f"core={core} is none of the cores that this process may use: {allowed}.")
    return core


def require_realtime() -> None:
    """Refuse real-time scheduling where this process may not have it.

    Raises:
        ValueError: if the operating system has none, or does not allow it.
    """
    if not hasattr(os, "sched_setscheduler"):
        raise ValueError("realtime=True needs the scheduler SCHED_FIFO of Linux; leave it out on this system.")
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError as error:
        raise ValueError(f"realtime=True is not allowed here ({error}); it needs root or CAP_SYS_NICE.") from error
    os.sched_setscheduler(0, before, parameters)


def act_on(core: int | None, *, realtime: bool) -> None:
    """Let this thread and those that it will start run on their own core, and before all others if so wanted."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    if realtime:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


def learn_beside(core: int | None) -> set[int] | None:
    """Keep all threads of this process, those that other libraries have started too, off a core.

    Returns:
        The cores that this process could use before; None if nothing was changed.
    """
    if core is None:
        return None
    before = os.sched_getaffinity(0)
    run_on((before - {core}) or before)
    return before


def run_on(cores: set[int] | None) -> None:
    """Let all threads of this process run on these cores; None changes nothing."""
    if cores is None:
        return
    tasks = Path("/proc/self/task")
    for thread in [int(task.name) for task in tasks.iterdir()] if tasks.is_dir() else [0]:
        with contextlib.suppress(ProcessLookupError):  # a thread that has ended since
            os.sched_setaffinity(thread, cores)


@contextlib.contextmanager
def behind_others(*, realtime: bool) -> Iterator[None]:
    """Let this thread run behind those that run before all others, for as long as it does what takes long.

    Args:
        realtime: whether this process runs before all others.
    """
    if not realtime:
        yield
        return
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
