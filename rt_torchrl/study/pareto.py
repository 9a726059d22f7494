"""What one quantity costs another: optima of a class of policies along one weight of the cost."""

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import nn

from rt_torchrl import figures
from rt_torchrl.atomic_file import write_results
from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.evaluation.limits import Optimum, exact_optimum
from rt_torchrl.evaluation.unseen import Judged, UnseenEpisodes
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.run_config import RunConfig, physics_of, plant_of
from rt_torchrl.study.yardsticks import TRAINING_SEED, Options, configured


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How thoroughly the optima are sought.

    Args:
        planned_on: number of episodes, with the seed of the trainings, that the optima are found on.
        unseen: number of unseen episodes that judge them.
        starts: number of random weights that the first optimum is sought from; the next ones start from the last.
        approach: gradients of Adam before those of L-BFGS, for the first optimum of a perceptron.
        iterations: gradients of L-BFGS for each optimum.
    """

    planned_on: int
    unseen: int
    starts: int
    approach: int
    iterations: int

    def __post_init__(self) -> None:
        for name, least in (("planned_on", 1), ("unseen", 2), ("starts", 1), ("approach", 0), ("iterations", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)} must be at least {least}.")


class Point(NamedTuple):
    """One controller on the unseen episodes: value of the weight, mean J_a, and mean of each of the plant's quantities.

    A classical controller has no weight, and its J_a is left out, because it differs from weight to weight.
    """

    weight: float | None
    cost: float | None
    merit: dict[str, float]


def pareto_front(
    recipe: Path, options: Options, weight: str, values: Sequence[float], effort: Effort
) -> Iterator[Point]:
    """The optima of a recipe's policy, on the true plant, for each value of one of its options, as they are found.

    Args:
        recipe: recipe of the plant.
        options: its other options.
        weight: name of the option that is the weight, such as ``vented-weight``.
        values: values of the weight, in the order in which one optimum starts from the last.
        effort: how thoroughly the optima are sought.

    Raises:
        ValueError: before any work, if a value is negative, not finite or given twice, or the recipe refuses it.
    """
    if not all(math.isfinite(value) and value >= 0.0 for value in values):
        raise ValueError(f"values={tuple(values)} of {weight} must be finite and not negative.")
    if len(set(values)) < max(2, len(values)):
        raise ValueError(f"values={tuple(values)} of {weight} must be two or more, and different.")
    torch.set_num_threads(1)
    configs = {value: configured(recipe, (*options, f"--{weight}", repr(float(value)))) for value in values}
    return _points(configs, effort)


def _points(configs: dict[float, RunConfig], effort: Effort) -> Iterator[Point]:
    last: nn.Module | None = None
    for value, config in configs.items():
        plant = plant_of(config)
        last = optimum(config, plant, last, effort).policy
        unseen = UnseenEpisodes(plant, effort.unseen)
        yield point(unseen.judge(unseen.fly(last)), value)


def optimum(config: RunConfig, plant: Plant, start: nn.Module | None, effort: Effort) -> Optimum:
    """The best policy of the configuration, from random weights or from those of ``start``."""
    met = UnseenEpisodes(plant, effort.planned_on, seed=TRAINING_SEED)
    first, physics = start is None, physics_of(config)

    def make(generator: torch.Generator) -> nn.Module:
        return config.make_policy(physics, generator) if start is None else copy.deepcopy(start)

    return exact_optimum(
        met,
        make,
        starts=effort.starts if first else 1,
        approach=effort.approach if first else 0,
        iterations=effort.iterations,
        few=effort.planned_on,
        polish=0,
    )


def classical_point(recipe: Path, options: Options, kind: type[ClassicalController], *, unseen: int) -> Point:
    """A classical controller, with its default gains, on the same unseen episodes."""
    config = configured(recipe, options)
    episodes = UnseenEpisodes(plant_of(config), unseen)
    return point(episodes.judge(episodes.fly_baseline(kind(physics_of(config)))), None)


def point(judged: Judged, weight: float | None) -> Point:
    """The means over the episodes."""
    return Point(weight, None if weight is None else judged.control_costs.mean().item(), judged.means())


def keep(
    path: Path,
    points: Sequence[Point],
    others: dict[str, Point],
    *,
    weight: str,
    merits: tuple[str, str],
    effort: Effort,
    title: str,
) -> None:
    """Write the front to ``path`` as JSON, and beside it as a figure with the suffix ``.png``.

    Args:
        path: the JSON file; its folder exists.
        points: optima along the weight.
        others: other controllers, by name.
        weight: name of the weight.
        merits: the two quantities that the figure shows.
        effort: how thoroughly the optima were sought.
        title: title of the figure.
    """
    from rt_torchrl.figures.comparison import pareto  # here, because the help of a recipe need not wait for Matplotlib

    front = [found._asdict() for found in points]
    classical = {name: found.merit for name, found in others.items()}
    write_results(path, {"weight": weight, "effort": effort, "front": front, "classical": classical})
    x, y = merits
    figure = pareto(
        [(found.weight or 0.0, found.merit[x], found.merit[y]) for found in points],
        {name: (found.merit[x], found.merit[y]) for name, found in others.items()},
        title=title,
        axes=merits,
    )
    figures.save_figure(figure, path.with_suffix(".png"))
