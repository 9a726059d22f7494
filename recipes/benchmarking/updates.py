"""CPU time of an iteration of step 2, by formula and by TorchRL's loss, in one process."""

import dataclasses
import statistics
import time
from pathlib import Path
from typing import Literal

import torch
from tensordict.nn import TensorDictModule

from benchmarking import cores
from rt_torchrl import Learner, PlantEnv
from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.twinning.learners import make_learner

RECIPES = Path(__file__).resolve().parent.parent
WAYS = ("explicit", "torchrl")
Way = Literal["explicit", "torchrl"]
EPISODE = 1_000
"""Greatest number of control intervals in the episode that the learners learn from."""


def milliseconds_of_update(plant: str, iterations: int, repeats: int) -> dict[Way, float]:
    """Median CPU time [ms] of one iteration of critic and policy on one thread, by each way to compute it.

    Sampling, priorities and targets count. The first update, which may compile, does not.

    Args:
        plant: name of the recipe, whose learner and policy are taken.
        iterations: number of iterations of critic and policy in an update.
        repeats: number of updates behind a median.
    """
    learners: dict[Way, Learner] = {way: _learner(plant, way, iterations) for way in WAYS}
    seconds: dict[Way, list[float]] = {way: [] for way in WAYS}
    with cores.torch_threads(1):
        for _ in range(repeats + 1):
            for way, learner in learners.items():
                start = time.process_time()
                learner.update()
                seconds[way].append(time.process_time() - start)
    return {way: 1e3 * statistics.median(found[1:]) / iterations for way, found in seconds.items()}


def _learner(plant: str, way: Way, iterations: int) -> Learner:
    """A learner that has seen one real episode of its first policy."""
    recipe, generator = load_recipe(RECIPES / f"{plant}.py"), torch.Generator().manual_seed(0)
    config = from_command_line(recipe.Config, [])
    system = config.plant()
    policy = config.make_policy(system, generator)
    counts = {"critic_iterations": iterations, "actor_iterations": iterations}
    found = make_learner(
        system, policy, dataclasses.replace(config.twinning.learner, update=way, **counts), generator=generator
    )
    actor = TensorDictModule(policy, in_keys=["observation"], out_keys=["action"])
    with torch.no_grad():
        found.store(PlantEnv(system, seed=0).rollout(min(EPISODE, system.n_steps), actor)[0])
    return found
