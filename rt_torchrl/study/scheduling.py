"""The study's tasks side by side, with one progress bar."""

import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from joblib import Parallel, delayed
from tqdm import tqdm

from rt_torchrl.study.task import Task, failure_of

GLANCE = 1.0
"""Time between two looks at what is done [s]."""


def side_by_side(batches: Sequence[Sequence[Task]], *, jobs: int = 0) -> None:
    """Run batches of tasks in several processes. The tasks of a batch run one after another in one process.

    A task that fails stops no other task; the results of the others are kept.

    Args:
        batches: tasks of each batch.
        jobs: number of processes; 0 means one for every core.

    Raises:
        RuntimeError: after all tasks, if some failed; it repeats their errors.
    """
    with progress([task for batch in batches for task in batch]):
        workers = Parallel(n_jobs=jobs or os.cpu_count() or 1, backend="loky", batch_size=1)
        said = workers(delayed(in_a_row)(batch) for batch in batches)
    failures = [failure for batch in said for failure in batch]
    if failures:
        raise RuntimeError(f"{len(failures)} failed, the others are kept:\n" + "\n".join(failures))


def on_this_machine(tasks: Sequence[Task], jobs: int) -> None:
    """Run tasks in processes on this machine, or all in one process, which then compiles nothing twice.

    Args:
        tasks: the tasks.
        jobs: number of processes; 0 means one for every core.

    Raises:
        RuntimeError: after all tasks, if some failed; it repeats their errors.
    """
    side_by_side([tasks] if jobs == 1 else [[task] for task in tasks], jobs=jobs)


def in_a_row(tasks: Sequence[Task]) -> list[str]:
    """Run tasks one after another, and return the errors of those that failed."""
    return [failure for task in tasks if (failure := failure_of(task))]


@contextmanager
def progress(tasks: Sequence[Task]) -> Iterator[None]:
    """A bar that counts the finished tasks, for as long as the context lasts.

    The bar looks for results that were missing at its last look. So it counts the tasks inside a batch, for which
    joblib's generator gives one result.
    """
    stopped = threading.Event()
    missing = [task for task in tasks if not task.done()]
    done = len(tasks) - len(missing)
    with tqdm(total=len(tasks), initial=done, unit="task", desc="study", dynamic_ncols=True) as bar:

        def look() -> None:
            missing[:] = [task for task in missing if not task.done()]
            bar.update(len(tasks) - len(missing) - bar.n)

        def watch() -> None:
            while not stopped.wait(GLANCE):
                look()

        watching = threading.Thread(target=watch, daemon=True)
        watching.start()
        try:
            yield
        finally:
            stopped.set()
            watching.join()
            look()
