"""A task of the study, and how it ends."""

from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Task(Protocol):
    """A computation whose result is kept in a file. As a string it says which one."""

    def run(self) -> Any:
        """Compute the result, unless it is there."""

    def done(self) -> bool:
        """Whether the result is there."""


def failure_of(task: Task) -> str | None:
    """Run a task, and return its error, or None if it has none."""
    try:
        task.run()
    except (Exception, SystemExit) as error:
        return f"{type(error).__name__}: {error}"
    return None
