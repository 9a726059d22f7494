"""What the study computes, side by side, with one progress bar."""

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
    """Something whose result is kept in a file."""

    def run(self) -> Any:
        """Compute it, unless that is done."""

    def done(self) -> bool:
        """Whether its result is there."""


def side_by_side(batches: Sequence[Sequence[Task]], *, backend: str, jobs: int) -> None:
    """Run batches of tasks through joblib, the tasks of a batch one after another in one process.

    A task that fails stops no other: what they compute is kept.

    Raises:
        ValueError: if the backend is Ray and there is none.
        RuntimeError: after all tasks, if some failed; with what they said.
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
    """One after another; returns what those that failed said."""
    failures = []
    for task in tasks:
        try:
            task.run()
        except Exception as error:
            failures.append(f"{type(error).__name__}: {error}")
    return failures


@contextmanager
def progress(tasks: Sequence[Task]) -> Iterator[None]:
    """A bar of the tasks that are done, for as long as the context lasts.

    The bar looks for results that were missing at its last look. So it counts the tasks inside a batch and on other
    machines; joblib's generator gives one result for a whole batch, and none at all on Ray's backend.
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
