"""Groups of lanes: realisations side by side in the vectors of the processor, and groups among threads."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor


class Group(NamedTuple):
    """Realisations ``first`` ... ``last`` − 1 in the lanes of a vector; the last one also fills lanes that are left."""

    first: int
    last: int
    lanes: int

    @property
    def live(self) -> int:
        """Number of lanes with a realisation of their own."""
        return self.last - self.first

    def gather(self, *arrays: np.ndarray) -> np.ndarray:
        """Rows ``n batch signals`` of arrays, side by side as ``n signals lanes``."""
        found, first = np.empty((len(arrays[0]), sum(x.shape[-1] for x in arrays), self.lanes)), 0
        for x in arrays:
            last = first + x.shape[-1]
            found[:, first:last, : self.live] = x[:, self.first : self.last].transpose(0, 2, 1)
            first = last
        found[:, :, self.live :] = found[:, :, self.live - 1 : self.live]
        return found

    def scatter(self, lanes: np.ndarray, array: np.ndarray) -> None:
        """Put ``n signals lanes`` into the rows of an array ``n batch signals``."""
        array[:, self.first : self.last] = lanes[:, :, : self.live].transpose(0, 2, 1)


def signals_of(drive: Iterable[Tensor]) -> np.ndarray:
    """The address of every signal of tensors ``n batch signals``, and the bytes to the next realisation and row."""
    found = []
    for x in drive:
        step, lane, signal = x.stride()
        first, lane = x.data_ptr(), lane if x.shape[1] > 1 else 0  # one row for all realisations
        found += [(first + 8 * signal * j, 8 * lane, 8 * step) for j in range(x.shape[2])]
    return np.array(found, np.int64).reshape(-1, 3)


def for_each_group(batch: int, lanes: int, work: Callable[[Group], None]) -> None:
    """Do the work of every group, on as many threads as torch may use; whoever is free takes the next group."""
    starts = range(0, batch, lanes)
    groups = iter([Group(first, min(first + lanes, batch), lanes) for first in starts])

    def share() -> None:
        for group in groups:
            work(group)

    others = min(torch.get_num_threads(), len(starts)) - 1
    helping = [_pool(others).submit(share) for _ in range(others)]
    try:
        share()
    finally:  # nobody may still write into the arrays of a call that has ended
        if helping:
            wait(helping)
    for thread in helping:
        thread.result()  # raises what it raised


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="rt_torchrl-native")


if hasattr(os, "register_at_fork"):  # threads do not live on in a forked process
    os.register_at_fork(after_in_child=_pool.cache_clear)
