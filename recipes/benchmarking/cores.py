"""The processor cores that this process may use."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch


def available() -> int:
    """Number of cores of this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """A context in which PyTorch has this many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def limited_to(count: int) -> Iterator[None]:
    """A context in which all threads of this process share the first ``count`` of its cores.

    JAX takes the number of its threads from the machine; with fewer cores its threads take turns on them. Only Linux
    can do this. Elsewhere the context limits nothing.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    _pin(set(sorted(before)[:count]))
    try:
        yield
    finally:
        _pin(before)


def _pin(cores: set[int]) -> None:
    for thread in Path("/proc/self/task").iterdir():
        try:
            os.sched_setaffinity(int(thread.name), cores)
        except ProcessLookupError:
            continue  # The thread has ended since it was listed.
