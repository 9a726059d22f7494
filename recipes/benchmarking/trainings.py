"""Short trainings, and the seconds that each step of the algorithm takes in them."""

import contextlib
import io
import json
from pathlib import Path

from rt_torchrl import Engine
from rt_torchrl.runs.command_line import from_command_line, load_recipe

RECIPES = Path(__file__).resolve().parent.parent


def seconds_of_steps(plant: str, engine: Engine, folder: Path, episodes: int, *, compiled: bool) -> list[float]:
    """Mean wall time [s] of each of the six ``STEPS`` in an episode of a short training.

    The first episode, in which the steps are compiled, does not count unless it is the only one.

    Args:
        plant: name of the recipe.
        engine: gradient engine.
        folder: run folder.
        episodes: number of episodes.
        compiled: whether to compile.
    """
    from rt_torchrl.figures.style import STEPS  # here, because --help need not wait for Matplotlib

    recipe = load_recipe(RECIPES / f"{plant}.py")
    options = ["--quick", "--episodes", str(episodes), "--engine", engine, "--log-dir", str(folder), "--overwrite"]
    options += ["--no-figures", "--untrained", "0", "--unseen-every", "0", "--threads", "1"]
    options += ["--compiled", str(compiled)]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        recipe.main(from_command_line(recipe.Config, options))
    records = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))["episodes"]
    counted = [record["seconds"] for record in records[1:] or records]
    return [sum(seconds.get(step, 0.0) for seconds in counted) / len(counted) for step in STEPS]
