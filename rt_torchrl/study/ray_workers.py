"""The study's tasks on a Ray cluster, where a worker that dies is replaced and its task done again."""

import os
import socket
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import ray
from ray._private import ray_constants
from ray.exceptions import RayError, RayTaskError
from tqdm import tqdm

from rt_torchrl.study.task import Task, failure_of

ATTEMPTS = 3
"""Number of workers that may die over one task before the task counts as failed."""


PATIENCE = 10.0
"""Time in which a cluster has to answer [s]."""


class Worker:
    """What runs in a process of the cluster."""

    def enter(self, folder: str) -> None:
        """Go to the folder in which the study runs, because the paths of the tasks may start there."""
        os.chdir(folder)

    def run(self, task: Task) -> str | None:
        return failure_of(task)


@dataclass
class Batch:
    """Tasks that one worker runs one after another, and the number of workers that died over the first of them."""

    tasks: deque[Task] = field(default_factory=deque)
    deaths: int = 0

    def next(self) -> None:
        self.tasks.popleft()
        self.deaths = 0


class RayWorkers:
    """Workers that share batches of tasks.

    Joblib's Ray backend gives everything up when one process dies, and Ray's own retries begin a whole batch again,
    those of its tasks that have failed included. Here the driver knows the task that each worker is at.

    Args:
        batches: tasks of each batch.
        jobs: greatest number of workers, each on one core. Workers for which the cluster has no core wait for one.
    """

    def __init__(self, batches: Iterable[Sequence[Task]], jobs: int):
        self._waiting = deque(Batch(deque(batch)) for batch in batches if batch)
        self._jobs = jobs
        self._at: dict[Any, tuple[Any, Batch]] = {}
        """Worker and batch by the call under way; the batch of a worker that is still entering has no tasks."""
        self._entering = Batch()
        self.failures: list[str] = []

    def run(self) -> list[str]:
        """Run all tasks, and return the errors of those that failed. However this ends, no worker is left.

        Raises:
            RuntimeError: if no worker can be started, or one cannot reach the folder in which the study runs.
        """
        try:
            while self._waiting or any(batch.tasks for _, batch in self._at.values()):
                self._start_workers()
                (call,), _ = ray.wait(list(self._at), num_returns=1)
                worker, batch = self._at.pop(call)
                if self._ended(call, batch):
                    self._give_work(worker, batch)
                else:
                    ray.kill(worker)  # a worker that cannot be reached may still be alive
        finally:
            for worker, _ in self._at.values():
                ray.kill(worker)
        return self.failures

    def _start_workers(self) -> None:
        entering = sum(batch is self._entering for _, batch in self._at.values())
        for _ in range(min(len(self._waiting) - entering, self._jobs - len(self._at))):
            worker: Any = ray.remote(num_cpus=1)(Worker).remote()
            self._at[worker.enter.remote(os.getcwd())] = worker, self._entering

    def _ended(self, call: Any, batch: Batch) -> bool:
        """Take the result of a call; whether its worker is alive."""
        try:
            failure = ray.get(call)
        except RayTaskError as error:
            if batch is self._entering:
                raise RuntimeError(
                    f"a worker cannot enter {os.getcwd()}: {error.cause}. All machines of the cluster need this folder "
                    "and that of the results, on a file system that they share."
                ) from error
            failure = f"{batch.tasks[0]}: {error.cause}"
        except RayError as error:
            self._died(batch, error)
            return False
        if batch is self._entering:
            batch.deaths = 0
            return True
        if failure:
            self.failures.append(failure)
        batch.next()
        return True

    def _give_work(self, worker: Any, batch: Batch) -> None:
        if not batch.tasks and self._waiting:
            batch = self._waiting.popleft()
        if batch.tasks:
            self._at[worker.run.remote(batch.tasks[0])] = worker, batch
        else:
            ray.kill(worker)

    def _died(self, batch: Batch, error: RayError) -> None:
        batch.deaths += 1
        reason = f"{type(error).__name__}: {str(error).splitlines()[0]}"
        if batch is self._entering:
            if batch.deaths == ATTEMPTS:
                raise RuntimeError(f"{ATTEMPTS} workers died one after another before any work. {reason}") from error
            return
        said = f"{batch.deaths} of {ATTEMPTS} workers died over {batch.tasks[0]}"
        if batch.deaths < ATTEMPTS:
            tqdm.write(f"{said}; another worker does it again", file=sys.stderr)
        else:
            self.failures.append(f"{said}. {reason}")
            batch.next()
        if batch.tasks:
            self._waiting.appendleft(batch)


@contextmanager
def connected(address: str | None, jobs: int) -> Iterator[int]:
    """A connection to a Ray cluster, for as long as the context lasts; gives the number of workers.

    Args:
        address: address of the cluster, as ``ray.init`` takes it. None means the cluster to which this process is
            connected, or that of the environment variable ``RAY_ADDRESS``, or a cluster on this machine alone, which
            ends with the context.
        jobs: greatest number of workers; 0 means one for every core of the cluster.

    Raises:
        ValueError: if nothing answers at the address.
    """
    if address is None and ray.is_initialized():
        yield jobs or cores()
        return
    address = address or os.environ.get("RAY_ADDRESS") or "local"
    if address != "local":
        require_answer(address)
    with without_copies():
        if address == "local":
            ray.init(address, num_cpus=jobs or None, include_dashboard=False)
        else:
            ray.init(address)
    try:
        yield jobs or cores()
    finally:
        ray.shutdown()


@contextmanager
def without_copies() -> Iterator[None]:
    """A context in which Ray starts workers as they are, also under ``uv run``.

    There it would give every worker a copy of the working folder and an environment that uv makes anew. An environment
    variable tells it not to, but Ray reads it on its import, and TorchRL has imported Ray before.
    """
    name = "RAY_ENABLE_UV_RUN_RUNTIME_ENV"
    before = getattr(ray_constants, name, False)  # older versions do not have it, nor do they copy
    setattr(ray_constants, name, False)
    try:
        yield
    finally:
        setattr(ray_constants, name, before)


def require_answer(address: str) -> None:
    """Refuse an address at which nothing answers; Ray would try it for minutes and then end the process.

    Raises:
        ValueError: if nothing answers at the address.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdigit()):
        return  # a word such as auto, which Ray looks up
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=PATIENCE).close()
    except OSError as error:
        raise ValueError(
            f"the Ray cluster at {address} does not answer ({error}); start it with ray start --head, or correct the "
            "address in --ray-address or RAY_ADDRESS."
        ) from error


def cores() -> int:
    """Number of cores of the connected cluster."""
    return max(1, int(ray.cluster_resources().get("CPU", 0)))
