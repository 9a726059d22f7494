"""The worth of reinforcement twinning: every arm on every plant, against classical controllers and the optimum."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import tyro

from rt_torchrl import main_of
from rt_torchrl.envs.unknown_systems import SYSTEMS
from rt_torchrl.runs.run_config import QUICK_UNSEEN
from rt_torchrl.study.contenders import (
    ARMS,
    CONTROLLERS,
    COUNTS,
    EPISODES,
    MULTIPLES,
    OTHER_CLOSURE,
    OTHER_PLANT,
    OWN_POLICY,
    QUICK_VARIANTS,
    SHORT,
    SHORT_EPISODES,
    policies_of,
)
from rt_torchrl.study.results import Entry, Results, arm_entry, yardstick_entry
from rt_torchrl.study.scheduling import side_by_side
from rt_torchrl.study.task import Task
from rt_torchrl.study.training import CHANGED, VARIANTS, Training
from rt_torchrl.study.unknown import by_plant
from rt_torchrl.study.yardstick import Yardstick
from rt_torchrl.study.yardsticks import (
    classical,
    cost_along_gain,
    cost_over_episodes,
    least_cost,
    oracle,
    plans,
    predictive_control,
)


@dataclass(frozen=True, kw_only=True)
class Config:
    """Train every arm on every plant, tune the classical controllers, find the oracle, and write tables and figures.

    The folder keeps finished results, so that the same command goes on where it was interrupted.

    Args:
        plants: all, or some of wind_turbine, flapping_wing, cryogenic_tank.
        seeds: number of trainings of every arm.
        unknown: what the real systems have beside their twins, as names of --unknown of the plants' recipes. A name
            counts for every plant that has it, and each plant needs one. Model error, another real system, is then left
            out. The results lie in folders of their own.
        variant_seeds: number of trainings of every arm under each sensor noise and model error; 0 leaves them out.
        jobs: number of trainings side by side, one thread each; 0 means one for every core of the machine or cluster.
        unseen: number of unseen episodes that judge everything.
        limit_episodes: number of unseen episodes, the first ones, on which the limit and model predictive control are
            computed; 0 leaves them out.
        folder: folder of tables, figures and all runs.
        quick: make the same tables from one seed of short trainings, and mark it as quick.
    """

    plants: tuple[str, ...] = ("all",)
    unknown: tuple[str, ...] = ()
    seeds: int = 5
    variant_seeds: int = 1
    jobs: int = 0
    unseen: int = 100
    limit_episodes: int = 8
    folder: Annotated[Path, tyro.conf.arg(name="log-dir", aliases=("--folder",))] = Path("runs/study")
    quick: bool = False

    def __post_init__(self):
        unknown = [name for name in self.plants if name not in (*CONTROLLERS, "all")]
        if unknown or not self.plants:
            raise ValueError(f"plants={self.plants} must be all, or some of {', '.join(CONTROLLERS)}.")
        for argument, least in (("seeds", 1), ("variant_seeds", 0), ("jobs", 0), ("unseen", 2)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least {least}.")
        if self.limit_episodes not in (0, *range(2, self.unseen + 1)):
            raise ValueError(f"limit_episodes={self.limit_episodes} must be 0, or from 2 to unseen={self.unseen}.")
        self.beside()

    def chosen(self) -> list[str]:
        """Names of the plants."""
        return list(CONTROLLERS) if "all" in self.plants else list(self.plants)

    def beside(self) -> dict[str, tuple[str, ...]]:
        """What the real system of each plant has beside its twin, by names."""
        return by_plant(self.unknown, {plant: SYSTEMS[plant] for plant in self.chosen()})

    @property
    def kept(self) -> Path:
        """Folder of the results; short trainings have their own, or the whole study would take theirs for its own."""
        return self.folder / "quick" if self.quick else self.folder

    def kept_of(self, plant: str, kind: str) -> Path:
        """Folder of the runs or yardsticks of a plant; each real system has its own."""
        return self.kept / kind / "+".join((plant, *self.beside()[plant]))

    @property
    def report(self) -> Path:
        """Folder of the tables; the same names in another order give the same one."""
        names = sorted({name for of_plant in self.beside().values() for name in of_plant})
        return self.kept / "unknown" / "+".join(names) if names else self.kept

    def variants(self) -> list[str]:
        """Variants that are trained beside the nominal one."""
        if not self.variant_seeds:
            return []
        left_out = ("nominal", *((CHANGED,) if self.unknown else ()))
        return [variant for variant in (QUICK_VARIANTS if self.quick else VARIANTS) if variant not in left_out]

    def episodes_of(self, plant: str) -> int:
        """Number of real episodes in every training of a plant."""
        return SHORT_EPISODES if self.quick else EPISODES[plant]

    def options_of(self, plant: str) -> tuple[str, ...]:
        """Further options of every training of a plant."""
        size = ("--quick", "--horizon", str(SHORT[plant])) if self.quick else ("--unseen", str(self.unseen))
        names = self.beside()[plant]
        return (*OWN_POLICY[plant], *size, *(("--unknown", *names) if names else ()))

    def trainings(self, plant: str) -> dict[tuple[str, str], list[Training]]:
        """Trainings of a plant by variant and arm, each a list over the seeds."""
        seeds, others = (1, min(self.variant_seeds, 1)) if self.quick else (self.seeds, self.variant_seeds)
        base = self.kept_of(plant, "runs")

        def every(arm: str, variant: str, count: int, *further: str, folder: str = "") -> list[Training]:
            place = base / (folder or variant.replace(" ", "-").replace("%", "percent")) / arm
            every_option = (*self.options_of(plant), "--unseen-every", "1", *further)
            common = {"recipe": recipe_of(plant), "arm": arm, "variant": variant, "options": every_option}
            common["episodes"] = self.episodes_of(plant)
            return [Training(seed=seed, folder=place / f"seed-{seed}", **common) for seed in range(count)]

        found = {("nominal", arm): every(arm, "nominal", seeds) for arm in ARMS}
        for name, policy in policies_of(plant, quick=self.quick).items():
            found["nominal", name] = every(
                "twinning", "nominal", seeds, *policy, folder="-".join(policy[:2]).strip("-")
            )
        return found | {(variant, arm): every(arm, variant, others) for variant in self.variants() for arm in ARMS}

    def yardsticks(self, plant: str) -> dict[str, Yardstick]:
        """The oracle and the classical controllers of a plant."""
        place = self.kept_of(plant, "yardsticks")
        unseen = QUICK_UNSEEN if self.quick else self.unseen
        starts, iterations, evaluations, episodes = (1, 5, 5, 3) if self.quick else (4, 40, 80, 20)
        best = {"unseen": unseen, "starts": starts, "iterations": iterations, "polish": 5 if self.quick else 20}
        tuned = {"unseen": unseen, "episodes": episodes, "evaluations": evaluations, "changed": not self.unknown}
        system = recipe_of(plant), ("--episodes", str(self.episodes_of(plant)), *self.options_of(plant))
        found = {"oracle": partial(oracle, *system, **best)}
        found |= {name: partial(classical, *system, kind, **tuned) for name, kind in CONTROLLERS[plant].items()}
        return {name: Yardstick(place / f"{name}.json", compute) for name, compute in found.items()}

    def limits(self, plant: str) -> dict[str, Yardstick]:
        """The clairvoyant optimum of a plant, and model predictive control where it finds plans."""
        if not self.limit_episodes:
            return {}
        count, iterations = (2, 100) if self.quick else (self.limit_episodes, 3000)
        size = {"unseen": QUICK_UNSEEN if self.quick else self.unseen, "count": count}
        system = recipe_of(plant), ("--episodes", str(self.episodes_of(plant)), *self.options_of(plant))
        found = {"limit": partial(least_cost, *system, **size, iterations=iterations)}
        if plans(*system):
            found["mpc"] = partial(predictive_control, *system, **size)
        place = self.kept_of(plant, "yardsticks")
        return {name: Yardstick(place / f"{name}-{count}.json", compute) for name, compute in found.items()}

    def line(self, plant: str) -> Yardstick | None:
        """Costs of a plant along one quantity; None for a plant whose tables say enough."""
        counts, iterations = (COUNTS[:2], 5) if self.quick else (COUNTS, 40)
        proportional = CONTROLLERS["cryogenic_tank"]["PI"]
        lines = {
            "cryogenic_tank": ("gain-line", partial(cost_along_gain, kind=proportional, multiples=MULTIPLES)),
            "flapping_wing": ("episode-line", partial(cost_over_episodes, counts=counts, iterations=iterations)),
        }
        if plant not in lines:
            return None
        name, compute = lines[plant]
        unseen = QUICK_UNSEEN if self.quick else self.unseen
        compute = partial(compute, recipe_of(plant), self.options_of(plant), unseen=unseen)
        return Yardstick(self.kept_of(plant, "yardsticks") / f"{name}.json", compute)


def recipe_of(plant: str) -> Path:
    """The recipe of a plant."""
    return Path(__file__).with_name(f"{plant}.py")


def compute(config: Config) -> None:
    """Compute everything that is not done yet, side by side, with one progress bar."""
    batches = short_batches(config) if config.quick else [[task] for task in ordered_tasks(config)]
    side_by_side(batches, jobs=config.jobs)


def ordered_tasks(config: Config) -> list[Task]:
    """Yardsticks first, then the nominal trainings, then those of the other variants."""
    tasks = [task for plant in config.chosen() for task in yardstick_tasks(config, plant)]
    # The plant that takes longest comes first.
    groups = [item for plant in reversed(config.chosen()) for item in config.trainings(plant).items()]
    for _, group in sorted(groups, key=lambda item: item[0][0] != "nominal"):
        tasks += group
    return tasks


def short_batches(config: Config) -> list[list[Task]]:
    """Batches of tasks, one worker for each: tasks that share graphs share a worker, because tracing takes longest.

    The longest batches come first; the others go wherever there is time.
    """
    batches, rest = [], []
    for plant in reversed(config.chosen()):
        groups = config.trainings(plant)
        together = [training for key, group in groups.items() if key[1] not in OTHER_PLANT for training in group]
        others = [[training] for key, group in groups.items() if key[1] in OTHER_PLANT for training in group]
        measures = yardstick_tasks(config, plant)
        batches.append(together if plant in OTHER_CLOSURE else [*measures, *together])
        rest += others + ([measures] if plant in OTHER_CLOSURE else [])
    return batches + rest


def yardstick_tasks(config: Config, plant: str) -> list[Task]:
    """Tasks that compute the yardsticks of a plant, its limit, and its line of costs if it has one."""
    line = config.line(plant)
    return [*config.yardsticks(plant).values(), *config.limits(plant).values(), *([line] if line else [])]


def entries_of(config: Config, plant: str) -> list[Entry]:
    """Entries of a plant: arms, then classical controllers, then the oracle."""
    trainings = config.trainings(plant)
    found = [arm_entry(name, trainings["nominal", name]) for name in (*ARMS, *policies_of(plant, quick=config.quick))]
    yardsticks = [yardstick_entry(name, task.run()) for name, task in config.yardsticks(plant).items()]
    return found + yardsticks[1:] + yardsticks[:1]


def harder_of(config: Config, plant: str) -> dict[str, list[Entry]]:
    """Entries of every arm under every variant; the model error has the classical controllers too."""
    every = config.trainings(plant)
    found = {variant: [arm_entry(arm, every[variant, arm]) for arm in ARMS] for variant in config.variants()}
    if CHANGED in found:
        tasks = {name: config.yardsticks(plant)[name] for name in CONTROLLERS[plant]}
        found[CHANGED] += [yardstick_entry(name, task.run()["changed"]) for name, task in tasks.items()]
    return found


def gather(config: Config) -> Results:
    """Gather the results of the study."""
    results = Results({}, {}, {}, {})
    for plant in config.chosen():
        nominal = config.trainings(plant)["nominal", "twinning"]
        results.entries[plant], results.variants[plant] = entries_of(config, plant), harder_of(config, plant)
        results.limits[plant] = [yardstick_entry(name, task.run()) for name, task in config.limits(plant).items()]
        results.summaries[plant] = [training.metrics()["summary"] for training in nominal]
    return results


def write(config: Config) -> Path:
    """Write the tables, the figures and ``study.json``; return the path of the tables."""
    from rt_torchrl.study.figures import draw  # here, because --help need not wait for Matplotlib
    from rt_torchrl.study.page import write as write_page

    results = gather(config)
    figures = draw(config.report, results, {plant: line for plant in config.chosen() if (line := config.line(plant))})
    made = {"quick": config.quick, "command": command(config), "unknown": config.beside()}
    return write_page(config.report, results, figures=figures, **made)


def command(config: Config) -> str:
    """The command line that makes these tables."""
    plants = " ".join([*config.plants, *(("--unknown", *config.unknown) if config.unknown else ())])
    size = f"--seeds {config.seeds} --variant-seeds {config.variant_seeds} --unseen {config.unseen}"
    limits = "" if config.limit_episodes == 8 else f" --limit-episodes {config.limit_episodes}"
    return f"uv run recipes/study.py --plants {plants} {'--quick' if config.quick else size}{limits}"


def main(config: Config) -> None:
    if config.unknown and config.variant_seeds:
        print(f"{CHANGED} is left out: with it the real systems are others than with --unknown.", flush=True)
    compute(config)
    print(f"tables in {write(config)}")


if __name__ == "__main__":
    main_of(Config, main)
