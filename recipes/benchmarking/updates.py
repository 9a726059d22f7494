"""CPU time of an iteration of step 2, traced and as TorchRL makes it, in one process."""

import dataclasses
import statistics
import time
from collections.abc import Callable  # noqa: TC003  (run-time checks read it)
from pathlib import Path
from typing import Literal

import torch
from tensordict.nn import TensorDictModule

from benchmarking import cores
from rt_torchrl import ActorCritic, PlantEnv
from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.steps.learn import BATCH, Iteration

RECIPES = Path(__file__).resolve().parent.parent
Way = Literal["traced", "torchrl"]
EPISODE = 1_000
"""Greatest number of control intervals in the episode that the learners learn from."""


def milliseconds_of_update(plant: str, iterations: int, repeats: int, algorithm: str = "ddpg") -> dict[Way, float]:
    """Median CPU time [ms] of one iteration of critic and policy on one thread, by each way to compute it.

    Sampling, priorities and targets count. The first update, which traces, does not.

    Args:
        plant: name of the recipe, whose learner and policy are taken.
        iterations: number of iterations of critic and policy in an update.
        repeats: number of updates behind a median.
        algorithm: name of the loss.
    """
    one, other = (_learner(plant, algorithm, iterations) for _ in range(2))
    ways: dict[Way, Callable[[], object]] = {"traced": one.update, "torchrl": lambda: update_by_torchrl(other)}
    seconds: dict[Way, list[float]] = {way: [] for way in ways}
    with cores.torch_threads(1):
        for _ in range(repeats + 1):
            for way, update in ways.items():
                start = time.process_time()
                update()
                seconds[way].append(time.process_time() - start)
    return {way: 1e3 * statistics.median(found[1:]) / iterations for way, found in seconds.items()}


def update_by_torchrl(learner: ActorCritic) -> None:
    """An update as a loop over TorchRL's parts makes it: one batch, one eager iteration, its priorities."""
    config, delay, buffer = learner.config, learner.method.delay, learner.memory.buffer
    kinds = [("both" if delay and k % delay == 0 else "critic") for k in range(1, config.critic_iterations + 1)]
    for kind in kinds + ([] if delay else ["actor"] * config.actor_iterations):
        batch = buffer.sample(learner.batch_size)
        keys = [key for key in BATCH if key in batch.keys(include_nested=True)]
        iteration = Iteration(learner, kind, keys)
        results = dict(zip(iteration.names, iteration.eager(*(batch[key] for key in keys)), strict=True))
        if "errors" in results:
            buffer.update_tensordict_priority(batch.set("td_error", results["errors"].float()))


def _learner(plant: str, algorithm: str, iterations: int) -> ActorCritic:
    """A learner that has seen one real episode of its first policy."""
    recipe, generator = load_recipe(RECIPES / f"{plant}.py"), torch.Generator().manual_seed(0)
    config = from_command_line(recipe.Config, [])
    system = config.plant()
    policy = config.make_policy(system, generator)
    changes = {"critic_iterations": iterations, "actor_iterations": iterations, "algorithm": algorithm}
    found = ActorCritic(system, policy, dataclasses.replace(config.twinning.learner, **changes), generator=generator)
    actor = TensorDictModule(policy, in_keys=["observation"], out_keys=["action"])
    with torch.no_grad():
        found.store(PlantEnv(system, seed=0).rollout(min(EPISODE, system.n_steps), actor)[0])
    return found
