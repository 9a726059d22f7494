"""Tasks of a study that die, fail or wait. Processes that have not imported Ray import this module."""

import json
import os
import signal
import time

PATIENCE = 120.0  # [s] for what takes seconds on a quiet machine


def wait_until(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


class Mortal:
    """A task that kills its first workers, or fails by its own error; a file says in which processes it was begun."""

    def __init__(self, path, deaths=0, error=None):
        self.path, self.deaths, self.error = path, deaths, error

    def __str__(self):
        return f"task {self.path.name}"

    def begun(self):
        log = self.path.with_suffix(".log")
        return log.read_text().split() if log.exists() else []

    def run(self):
        with self.path.with_suffix(".log").open("a") as file:
            print(os.getpid(), file=file)
        if len(self.begun()) <= self.deaths:
            os.kill(os.getpid(), signal.SIGKILL)
        if self.error:
            raise self.error
        self.path.write_text(json.dumps({"begun": len(self.begun())}))

    def done(self):
        return self.path.exists()


class Waiting(Mortal):
    """A task that waits for a sign at its first start."""

    def run(self):
        with self.path.with_suffix(".log").open("a") as file:
            print(os.getpid(), file=file)
        if len(self.begun()) == 1:
            wait_until((self.path.parent / "go").exists)
        self.path.write_text("{}")


class Unreadable(Mortal):
    """A task that no worker can read."""

    def __reduce__(self):
        return _missing, ()


def _missing():
    raise ModuleNotFoundError("No module named 'own_plant'")
