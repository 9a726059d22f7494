"""Yardsticks of the trainings: the best that a class of policies can do, and tuned classical controllers."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import nn

from rt_torchrl.control.classical import ClassicalController, tune
from rt_torchrl.evaluation.limits import (
    Contender,
    LimitConfig,
    exact_optimum,
    few_starts,
    limit,
    predictive,
)
from rt_torchrl.evaluation.unseen import UNSEEN_SEED, UnseenEpisodes
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.runs.run_config import RunConfig, physics_of, plant_of
from rt_torchrl.study.training import CHANGED, VARIANTS
from rt_torchrl.trajectories.engines.parallel import missing_for_compilation

Options = tuple[str, ...]
"""Options of a recipe's command line."""
TRAINING_SEED = 0
"""Seed of the disturbances that tune the classical controllers; the unseen episodes have another seed."""


def oracle(recipe: Path, options: Options, *, unseen: int, starts: int, iterations: int, polish: int) -> dict[str, Any]:
    """Optimise the trainings' policy with exact gradients, on the true plant and on the unseen episodes themselves.

    Args:
        recipe: recipe of the plant.
        options: options of its trainings.
        unseen: number of unseen episodes.
        starts: number of random initial weights.
        iterations: gradients from each start, on a few of the episodes.
        polish: gradients of the best start, on all episodes.

    Returns:
        ``J_a_of_each_start``, per-episode ``costs`` of the best policy and the statistics of :class:`Judged`.
    """
    config = configured(recipe, options)
    episodes = unseen_episodes(plant_of(config), unseen)
    make_policy = partial(config.make_policy, physics_of(config))
    best = exact_optimum(episodes, make_policy, starts=starts, iterations=iterations, polish=polish)
    found = episodes.judge(episodes.fly(best.policy))
    return {"costs": found.control_costs.tolist(), "J_a_of_each_start": best.costs} | found.statistics()


def classical(
    recipe: Path,
    options: Options,
    kind: type[ClassicalController],
    *,
    unseen: int,
    episodes: int,
    evaluations: int,
    changed: bool = True,
) -> dict[str, Any]:
    """Tune a classical controller by a simplex search on training episodes, and judge it on the unseen episodes.

    It acts on what sensors read of the true system, on which it is tuned and judged.

    Args:
        recipe: recipe of the plant.
        options: options of its trainings; with those of the model error they give the real system at its end.
        kind: class of the controller; a controller without gains is judged as it is.
        unseen: number of unseen episodes.
        episodes: number of training episodes.
        evaluations: number of times that the search may fly all training episodes.
        changed: whether to judge it on the system with model error, too, with which a system that has dynamics beside
            its twin does not go.

    Returns:
        ``gains``, per-episode ``costs`` and the statistics of :class:`Judged`; ``changed`` holds
        ``costs`` and statistics on the system with model error.
    """
    config = configured(recipe, options)
    plant = plant_of(config)
    judged = unseen_episodes(plant, unseen)
    controller = tuned(kind, physics_of(config), plant, episodes=episodes, evaluations=evaluations)
    found = {"gains": controller.named_gains()} | record(judged, controller)
    if not changed:
        return found
    judged.closure = changed_closure(plant, recipe, options) or plant.closure
    return found | {"changed": record(judged, controller)}


def tuned(
    kind: type[ClassicalController], physics: Plant, plant: Plant, *, episodes: int, evaluations: int
) -> ClassicalController:
    """The controller with the best gains that a search finds on training episodes; one without gains as it is.

    Args:
        kind: class of the controller.
        physics: the plant as it is known, for which the controller is made.
        plant: the true plant, which it flies.
        episodes: number of training episodes.
        evaluations: number of times that the search may fly all of them.
    """
    start = {"gains": kind.placed_gains} if kind.placed_gains else {}
    controller = kind(physics, **start, compiled=missing_for_compilation() is None)
    generator = torch.Generator().manual_seed(TRAINING_SEED)
    if kind.gain_units:
        state = plant.draw_initial_state(episodes, generator)
        tune(controller, state, plant.draw_exogenous(episodes, generator), evaluations=evaluations, plant=plant)
    return controller


def record(judged: UnseenEpisodes, controller: ClassicalController) -> dict[str, Any]:
    """Per-episode ``costs`` and the statistics of :class:`Judged`."""
    found = judged.judge(judged.fly_baseline(controller))
    return {"costs": found.control_costs.tolist()} | found.statistics()


def cost_along_gain(
    recipe: Path, options: Options, kind: type[ClassicalController], *, unseen: int, multiples: Sequence[float]
) -> dict[str, Any]:
    """J_a of a classical controller over its first gain; the other gains keep their defaults.

    Args:
        recipe: recipe of the plant.
        options: options of its trainings.
        kind: class of the controller.
        unseen: number of unseen episodes.
        multiples: multiples of the default gain.

    Returns:
        ``name`` and ``unit`` of the gain, its ``values`` and mean ``costs``.
    """
    config = configured(recipe, options)
    judged = unseen_episodes(plant_of(config), unseen)
    controller = kind(physics_of(config), compiled=missing_for_compilation() is None)
    values, costs = [kind.default_gains[0] * multiple for multiple in multiples], []
    for value in values:
        controller.log_gains[0] = math.log(value)
        costs.append(judged.judge(judged.fly_baseline(controller)).control_costs.mean().item())
    name, unit = next(iter(kind.gain_units.items()))
    return {"name": name, "unit": unit, "values": values, "costs": costs}


def cost_over_episodes(
    recipe: Path, options: Options, *, unseen: int, counts: Sequence[int], iterations: int
) -> dict[str, Any]:
    """J_a of the trainings' policy over the number of training episodes that exact gradients plan on.

    A training that meets as many episodes cannot be expected to cost less.

    Args:
        recipe: recipe of the plant.
        options: options of its trainings.
        unseen: number of unseen episodes to judge on.
        counts: numbers of training episodes, whose true disturbances the plan knows.
        iterations: gradients of each plan, from the same initial weights.

    Returns:
        ``name`` and ``unit`` of the abscissa, its ``values`` and mean ``costs`` on the unseen episodes.
    """
    config, costs = configured(recipe, options), []
    plant = plant_of(config)
    make_policy = partial(config.make_policy, physics_of(config))
    judged, met = unseen_episodes(plant, unseen), unseen_episodes(plant, max(counts), seed=TRAINING_SEED)
    for count in counts:
        best = exact_optimum(met, make_policy, starts=1, iterations=iterations, few=count, polish=0)
        costs.append(judged.control_costs(best.policy).mean().item())
    return {"name": "episodes planned on", "unit": "-", "values": list(counts), "costs": costs}


def least_cost(recipe: Path, options: Options, *, unseen: int, count: int, iterations: int) -> dict[str, Any]:
    """The least cost that any controller can have: the optimal commands where all disturbances are known.

    Args:
        recipe: recipe of the plant.
        options: options of its trainings.
        unseen: number of unseen episodes.
        count: number of them, the first ones, whose commands are optimised.
        iterations: greatest number of iterations from each start.

    Returns:
        What :func:`contender_of` returns; ``details`` say how well the commands are known to be an optimum.
    """
    episodes, known = first_episodes(recipe, options, unseen=unseen, count=count)
    descent = replace(known.descent, iterations=iterations)
    return contender_of(limit(episodes, few_starts(episodes, known), hold=known.hold, config=descent))


def predictive_control(recipe: Path, options: Options, *, unseen: int, count: int) -> dict[str, Any]:
    """Model predictive control on the exact model, without preview, as the recipe sets it up.

    Args:
        recipe: recipe of the plant.
        options: options of its trainings.
        unseen: number of unseen episodes.
        count: number of them, the first ones, that it flies.

    Returns:
        What :func:`contender_of` returns.

    Raises:
        ValueError: if the recipe has no model predictive control with these options.
    """
    episodes, known = first_episodes(recipe, options, unseen=unseen, count=count)
    if known.window is None:
        raise ValueError(f"recipe={recipe} has no model predictive control with the options {' '.join(options)}.")
    return contender_of(predictive(episodes, known.window))


def plans(recipe: Path, options: Options) -> bool:
    """Whether a recipe has model predictive control with these options."""
    known = configured(recipe, options).limit()
    return known is not None and known.window is not None


def first_episodes(recipe: Path, options: Options, *, unseen: int, count: int) -> tuple[UnseenEpisodes, LimitConfig]:
    """The first of the unseen episodes, and how the limit of their cost is computed.

    Raises:
        ValueError: if the recipe does not say how.
    """
    config = configured(recipe, options)
    if (known := config.limit()) is None:
        raise ValueError(f"recipe={recipe} does not say how the limit is computed; override RunConfig.limit().")
    episodes = unseen_episodes(plant_of(config), unseen).first(count)
    episodes.physics = physics_of(config)
    return episodes, known


def contender_of(found: Contender) -> dict[str, Any]:
    """Per-episode ``costs``, means of the plant's quantities in ``merit``, ``milliseconds`` and ``details``."""
    merit = {name: {"mean": value} for name, value in found.merit.items()}
    return {"costs": found.costs, "merit": merit, "milliseconds": found.milliseconds, "details": found.details}


def unseen_episodes(plant: Plant, count: int, *, seed: int = UNSEEN_SEED) -> UnseenEpisodes:
    """The unseen episodes that judge everything, or those of another seed; one thread leaves cores to other workers."""
    torch.set_num_threads(1)
    return UnseenEpisodes(plant, count, compiled=missing_for_compilation() is None, seed=seed)


def changed_closure(system: Plant, recipe: Path, options: Options) -> nn.Module | None:
    """Closure of the real system at the end of a training with model error; None where it is the plant's own."""
    config = configured(recipe, (*VARIANTS[CHANGED], *options))
    wear = config.wear(system)
    return None if wear is None else wear(config.episodes - 1)


def configured(recipe: Path, options: Options) -> RunConfig:
    """The recipe's configuration under these options."""
    return from_command_line(load_recipe(recipe).Config, options).effective()
