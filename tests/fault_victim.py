"""A training in a process of its own, which a test of faults stops."""

import contextlib
import functools
import os
import signal
from pathlib import Path

from small_runs import FULL, small_run

from rt_torchrl import Run, RunConfig, shipped_plants
from rt_torchrl.envs.cryogenic_tank.controllers import PIValve
from rt_torchrl.envs.flapping_wing.controllers import TrimmedPD
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController

EPISODES = 5
QUICK = {"figures": False}
SHIPPED = {
    "wind_turbine": ({"horizon": 30.0}, JonkmanController),
    "flapping_wing": ({"dt": 0.002, "horizon": 0.12}, TrimmedPD),
    "cryogenic_tank": ({"horizon": 1800.0}, PIValve),
    "pendulum": ({"horizon": 3.0}, None),
}
"""The shipped plants with short episodes, each with the controller that the training begins with."""


def shipped_run(name, folder, **options):
    """A training on a shipped plant that takes seconds."""
    lengths, controller = SHIPPED[name]
    start = "random" if controller is None else "controller"
    shared = {"episodes": EPISODES, "unseen": 2, "start": start, "threads": 1, "twinning": FULL}
    return Run(
        RunConfig(log_dir=folder, **shared | QUICK | options), shipped_plants()[name](**lengths), first=controller
    )


def victim(folder, options, kill_at=None, plant=None):
    """A training in a process of its own; with ``kill_at`` it kills itself in its so manieth renaming of a file."""
    with open(os.devnull, "w") as quiet, contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
        if kill_at is not None:
            rename, left = Path.replace, iter(range(kill_at))

            def mortal(self, target):
                if next(left, None) is None:
                    os.kill(os.getpid(), signal.SIGKILL)
                return rename(self, target)

            Path.replace = mortal
        with contextlib.suppress(SystemExit, KeyboardInterrupt):
            run = small_run if plant is None else functools.partial(shipped_run, plant)
            run(folder, **{"episodes": EPISODES} | QUICK | options).train()
