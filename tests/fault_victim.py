"""A training in a process of its own, which a test of faults stops."""

import contextlib
import os
import signal
from pathlib import Path

from small_runs import small_run

EPISODES = 5
QUICK = {"figures": False, "untrained": 0}


def victim(folder, options, kill_at=None):
    """A training in a process of its own; with ``kill_at`` it kills itself in its so manieth renaming of a file."""
    if folder is None:
        return
    with open(os.devnull, "w") as quiet, contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
        if kill_at is not None:
            rename, left = Path.replace, iter(range(kill_at))

            def mortal(self, target):
                if next(left, None) is None:
                    os.kill(os.getpid(), signal.SIGKILL)
                return rename(self, target)

            Path.replace = mortal
        with contextlib.suppress(SystemExit, KeyboardInterrupt):
            small_run(folder, episodes=EPISODES, **QUICK, **options).train()
