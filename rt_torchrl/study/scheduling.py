"""The study's tasks side by side, with one progress bar."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

from joblib import Parallel, delayed
from tqdm import tqdm

GLANCE = 1.0
"""Time between two looks at what is done [s]."""


@runtime_checkable
class Task(Protocol):
    """A computation whose result is kept in a file."""

    def run(self) -> Any:
        """Compute the result, unless it is there."""

    def done(self) -> bool:
        """Whether the result is there."""


def side_by_side(batches: Sequence[Sequence[Task]], *, backend: str, jobs: int) -> None:
    """Run batches of tasks through joblib. The tasks of a batch run one after another in one process.

    A task that fails stops no other task; the results of the others are kept.

    Args:
        batches: tasks of each batch.
        backend: joblib's backend, loky or ray.
        jobs: number of processes.

    Raises:
        ValueError: if the backend is Ray and Ray is not installed.
        RuntimeError: after all tasks, if some failed; it repeats their errors.
    """
    if backend == "ray":
        try:
            from ray.util.joblib import register_ray
        except ImportError as error:
            raise ValueError("backend='ray' needs Ray: install the extra, pip install 'rt_torchrl[ray]'.") from error
        register_ray()
    with progress([task for batch in batches for task in batch]):
        said = Parallel(n_jobs=jobs, backend=backend, batch_size=1)(delayed(in_a_row)(batch) for batch in batches)
    failures = [failure for batch in said for failure in batch]
    if failures:
        raise RuntimeError(f"{len(failures)} failed, the others are kept:\n" + "\n".join(failures))


def in_a_row(tasks: Sequence[Task]) -> list[str]:
    """Run tasks one after another, and return the errors of those that failed."""
    failures = []
    for task in tasks:
        try:
            task.run()
        except Exception as error:
            failures.append(f"{type(error).__name__}: {error}")
    return failures


@contextmanager
def progress(tasks: Sequence[Task]) -> Iterator[None]:
    """A bar that counts the finished tasks, for as long as the context lasts.

    The bar looks for results that were missing at its last look. So it counts the tasks inside a batch and on other
    machines. joblib's generator gives one result for a whole batch, and Ray's backend refuses it.
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
