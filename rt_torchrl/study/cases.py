"""What the studies on systems that twins do not know fly: plants with policies whose optimum exact gradients find."""

from functools import partial
from pathlib import Path

from rt_torchrl.study.yardstick import Yardstick
from rt_torchrl.study.yardsticks import Options, oracle

CASES = {name: name for name in ("wind_turbine", "flapping_wing", "hop", "cryogenic_tank")} | {"hop": "flapping_wing"}
"""Plant of each case; the hop is a task of the drone."""
POLICY: dict[str, Options] = {
    "wind_turbine": ("--policy", "scheduled"),
    "flapping_wing": ("--policy", "paper"),
    "hop": ("--policy", "paper", "--task", "hop"),
    "cryogenic_tank": ("--command", "drop", "--end-weight", "0"),
}
"""Policies of few weights."""
UNSEEN = {"wind_turbine": 50, "flapping_wing": 100, "hop": 192, "cryogenic_tank": 50}
"""Number of unseen episodes that judge everything by default; a few hops cost ten times as much as the others."""


def names(system: str) -> Options:
    """Names of ``--unknown`` of a system, which a plus combines; none of ``nothing``."""
    return () if system == "nothing" else tuple(system.split("+"))


def options_of(case: str, system: str) -> Options:
    """Options of the recipe that make the system and its policy."""
    return (*POLICY[case], *(("--unknown", *names(system)) if names(system) else ()))


def optimum(path: Path, recipe: Path, options: Options, *, unseen: int, starts: int, iterations: int) -> Yardstick:
    """The best policy of the class on the true system.

    Args:
        path: file to keep it in.
        recipe: recipe of the plant.
        options: options of its trainings.
        unseen: number of unseen episodes.
        starts: number of random starts.
        iterations: number of gradients of each start on ten episodes; a third as many follow on all.
    """
    effort = {"starts": starts, "iterations": iterations, "polish": iterations // 3}
    return Yardstick(path, partial(oracle, recipe, (*options, "--unseen", str(unseen)), unseen=unseen, **effort))
