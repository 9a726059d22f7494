"""What trainings are measured against: the best that a class of policies can do, and tuned classical controllers."""

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import nn

from rt_torchrl.catalogue import plants
from rt_torchrl.classical import ClassicalController
from rt_torchrl.compilation import missing_for_compilation
from rt_torchrl.evaluation import UnseenEpisodes, exact_optimum
from rt_torchrl.plant import Plant
from rt_torchrl.recipe import load_recipe
from rt_torchrl.study.training import CHANGED, VARIANTS
from rt_torchrl.tuning import tune

TRAINING_SEED = 0
"""Seed of the disturbances that classical controllers are tuned on; the unseen episodes have another."""


def kept(path: Path, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a file holds, or else what is computed now and written there."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(compute(), indent=2) + "\n")
    return json.loads(path.read_text())


def oracle(plant: str, path: Path, *, unseen: int, starts: int, iterations: int, polish: int) -> dict[str, Any]:
    """The plant's own policy, optimised with exact gradients on the true plant and on the unseen episodes themselves.

    Args:
        plant: folder of the plant under envs.
        path: file to keep the result in.
        unseen: number of unseen episodes.
        starts: number of random initial weights.
        iterations: gradients from each, on a few of the episodes.
        polish: gradients of the best, on all of them.

    Returns:
        ``J_a_of_each_start``, per-episode ``costs`` of the best and the statistics of :class:`Judged`.
    """

    def compute() -> dict[str, Any]:
        torch.set_num_threads(1)
        system = plants()[plant]()
        episodes = UnseenEpisodes(system, unseen, compiled=missing_for_compilation() is None)
        best = exact_optimum(episodes, system.make_policy, starts=starts, iterations=iterations, polish=polish)
        found = episodes.judge(episodes.fly(best.policy))
        costs = {"costs": found.control_costs.tolist(), "J_a_of_each_start": best.costs}
        return costs | found.statistics()

    return kept(path, compute)


def classical(
    plant: str,
    kind: type[ClassicalController],
    path: Path,
    *,
    unseen: int,
    episodes: int,
    evaluations: int,
    recipe: Path,
    options: tuple[str, ...],
) -> dict[str, Any]:
    """A classical controller, tuned by a simplex search on training episodes and judged on the unseen ones.

    Args:
        plant: folder of the plant under envs.
        kind: of the controller; one without gains is judged as it is.
        path: file to keep the result in.
        unseen: number of unseen episodes.
        episodes: number of training episodes.
        evaluations: flights of all of them that the search may take.
        recipe: of the plant.
        options: of its trainings; with them and its model error it tells how the real system ends.

    Returns:
        ``gains``, per-episode ``costs`` and the statistics of :class:`Judged`; the same on the system with model error
        under ``changed``.
    """

    def compute() -> dict[str, Any]:
        torch.set_num_threads(1)
        controller = tuned(kind, plants()[plant](), episodes=episodes, evaluations=evaluations)
        system = controller.plant
        judged = UnseenEpisodes(system, unseen, compiled=missing_for_compilation() is None)
        found = {"gains": controller.named_gains()} | record(judged, controller)
        judged.closure = changed_closure(system, recipe, options) or system.closure
        return found | {"changed": record(judged, controller)}

    return kept(path, compute)


def tuned(kind: type[ClassicalController], plant: Plant, *, episodes: int, evaluations: int) -> ClassicalController:
    """A controller with the best gains that a search finds on training episodes, if it has gains."""
    start = {"gains": kind.placed_gains} if kind.placed_gains else {}
    controller = kind(plant, **start, compiled=missing_for_compilation() is None)
    generator = torch.Generator().manual_seed(TRAINING_SEED)
    if kind.gain_units:
        state = plant.draw_initial_state(episodes, generator)
        tune(controller, state, plant.draw_exogenous(episodes, generator), evaluations=evaluations)
    return controller


def record(judged: UnseenEpisodes, controller: ClassicalController) -> dict[str, Any]:
    """Per-episode ``costs`` and the statistics of :class:`Judged`."""
    found = judged.judge(judged.fly_baseline(controller))
    return {"costs": found.control_costs.tolist()} | found.statistics()


def cost_along_gain(
    plant: str, kind: type[ClassicalController], path: Path, *, unseen: int, multiples: Sequence[float]
) -> dict[str, Any]:
    """J_a of a classical controller over its first gain, the others as by default: a line through the landscape.

    Args:
        plant: folder of the plant under envs.
        kind: of the controller.
        path: file to keep the result in.
        unseen: number of unseen episodes.
        multiples: of the default gain.

    Returns:
        ``name`` and ``unit`` of the gain, its ``values`` and mean ``costs``.
    """

    def compute() -> dict[str, Any]:
        torch.set_num_threads(1)
        system, compiled = plants()[plant](), missing_for_compilation() is None
        judged, controller = UnseenEpisodes(system, unseen, compiled=compiled), kind(system, compiled=compiled)
        values, costs = [kind.default_gains[0] * multiple for multiple in multiples], []
        for value in values:
            controller.log_gains[0] = math.log(value)
            costs.append(judged.judge(judged.fly_baseline(controller)).control_costs.mean().item())
        name, unit = next(iter(kind.gain_units.items()))
        return {"name": name, "unit": unit, "values": values, "costs": costs}

    return kept(path, compute)


def changed_closure(system: Plant, recipe: Path, options: tuple[str, ...]) -> nn.Module | None:
    """Closure of the real system at the end of a training with model error; None for the plant's own."""
    module = load_recipe(recipe)
    config = tyro.cli(module.Config, args=[*VARIANTS[CHANGED], *options]).effective()
    wear = config.wear(system)
    return None if wear is None else wear(config.episodes - 1)
