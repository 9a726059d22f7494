"""Groups of lanes: realisations side by side in the vectors of the processor, and groups among threads."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy as np
import torch

from rt_torchrl.trajectories.engines.interval import Drive


class Group(NamedTuple):
    """Realisations ``first`` ... ``last`` − 1 in the lanes of a vector; the last one also fills lanes that are left."""

    first: int
    last: int
    lanes: int

    @property
    def live(self) -> int:
        """Number of lanes with a realisation of their own."""
        return self.last - self.first

    def gather(self, array: np.ndarray) -> np.ndarray:
        """Rows ``n batch signals`` as ``n signals lanes``."""
        found = array[:, self.first : self.last]
        if self.live < self.lanes:
            found = found[:, np.minimum(np.arange(self.lanes), self.live - 1)]
        return found.transpose(0, 2, 1)

    def scatter(self, lanes: np.ndarray, array: np.ndarray) -> None:
        """Put ``n signals lanes`` into the rows of an array ``n batch signals``."""
        array[:, self.first : self.last] = lanes[:, :, : self.live].transpose(0, 2, 1)

    def packed(self, drive: "Signals", first: int, last: int) -> np.ndarray:
        """The drive of intervals ``first`` ... ``last`` − 1, ``n n_x lanes``."""
        t, exogenous, command = (signal[first:last] for signal in drive)
        n_z, n_a = exogenous.shape[-1], command.shape[-1]
        x = np.empty((last - first, 1 + n_z + n_a, self.lanes))
        x[:, :1] = t[:, None] if t.shape[1] == 1 else self.gather(t[:, :, None])
        x[:, 1 : 1 + n_z] = self.gather(exogenous)
        x[:, 1 + n_z :] = self.gather(command)
        return x


class Signals(NamedTuple):
    """The drive in NumPy's arrays, which share the memory of torch's."""

    t: np.ndarray
    exogenous: np.ndarray
    command: np.ndarray

    @classmethod
    def of(cls, drive: Drive) -> "Signals":
        return cls(*(x.detach().numpy() for x in drive))


def for_each_group(batch: int, lanes: int, work: Callable[[Group], None]) -> None:
    """Do the work of every group, on as many threads as torch may use."""
    groups = [Group(first, min(first + lanes, batch), lanes) for first in range(0, batch, lanes)]
    threads = min(torch.get_num_threads(), len(groups))
    if threads == 1:
        for group in groups:
            work(group)
        return

    def share(thread: int) -> None:
        for group in groups[thread::threads]:
            work(group)

    for _ in _pool(threads).map(share, range(threads)):
        pass


def pieces(n: int, length: int) -> list[tuple[int, int]]:
    """Cut n intervals into pieces of at most ``length``."""
    return [(first, min(first + length, n)) for first in range(0, n, length)]


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="rt_torchrl-native")


if hasattr(os, "register_at_fork"):  # threads do not live on in a forked process
    os.register_at_fork(after_in_child=_pool.cache_clear)
