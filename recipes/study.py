"""What reinforcement twinning is worth: every arm on every plant, classical controllers, and the best possible."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from joblib import Parallel, delayed
from tqdm import tqdm

from rt_torchrl.classical import ClassicalController
from rt_torchrl.envs.cryogenic_tank.valves import OnOffValve, PIValve
from rt_torchrl.envs.flapping_wing.pd import TrimmedPD
from rt_torchrl.envs.wind_turbine.jonkman import JonkmanController
from rt_torchrl.figures import study as charts
from rt_torchrl.run_config import QUICK_UNSEEN
from rt_torchrl.runner import main_of
from rt_torchrl.study import page, report
from rt_torchrl.study.findings import Entry, Results, arm_entry, yardstick_entry
from rt_torchrl.study.training import CHANGED, VARIANTS, Training
from rt_torchrl.study.yardsticks import classical, cost_along_gain, oracle

ARMS = ("twinning", "model_free", "model_based")
CONTROLLERS: dict[str, dict[str, type[ClassicalController]]] = {
    "wind_turbine": {"Jonkman": JonkmanController},
    "flapping_wing": {"PD": TrimmedPD},
    "cryogenic_tank": {"on-off": OnOffValve, "PI": PIValve},
}
POLICIES: dict[str, dict[str, tuple[str, ...]]] = {
    "wind_turbine": {
        "twinning, gain-scheduled": ("--policy", "scheduled"),
        "twinning, with bias": ("--policy", "bias"),
        "twinning, perceptron": ("--policy", "mlp"),
    },
    "flapping_wing": {"twinning, perceptron": ("--policy", "mlp")},
}
"""Policies beside a plant's own that twinning trains too, as options of its recipe."""

EPISODES = {"wind_turbine": 20, "flapping_wing": 10, "cryogenic_tank": 10}
"""Real episodes of a training, of every arm alike; more leave drone and tank where they are."""
GAIN_LINES: dict[str, type[ClassicalController]] = {"cryogenic_tank": PIValve}
"""Controllers whose cost over their first gain is drawn."""
MULTIPLES = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1e3, 1e4, 1e5)
"""Of the default gain, for these."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Train every arm on every plant, tune the classical controllers, find the oracle, and write a report.

    What is done already in the folder is kept: the same command goes on where it was interrupted.

    Args:
        plants: all, or some of wind_turbine, flapping_wing, cryogenic_tank.
        seeds: trainings of every arm.
        variant_seeds: trainings of every arm under each kind of sensor noise and model error; 0 leaves them out.
        jobs: trainings side by side, one thread each; 0 takes one for every core.
        backend: of joblib; ray spreads over a Ray cluster and needs the extra ``ray``.
        unseen: number of unseen episodes that everything is judged on.
        folder: of the report and of all runs.
        quick: the same report from one seed of short trainings, marked as such.
    """

    plants: tuple[str, ...] = ("all",)
    seeds: int = 5
    variant_seeds: int = 2
    jobs: int = 0
    backend: Literal["loky", "ray"] = "loky"
    unseen: int = 100
    folder: Path = Path("runs/study")
    quick: bool = False

    def __post_init__(self):
        unknown = [name for name in self.plants if name not in (*CONTROLLERS, "all")]
        if unknown or not self.plants:
            raise ValueError(f"plants={self.plants} must be all, or some of {', '.join(CONTROLLERS)}.")
        for argument, least in (("seeds", 1), ("variant_seeds", 0), ("jobs", 0), ("unseen", 2)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least {least}.")

    def chosen(self) -> list[str]:
        """The plants, by folder."""
        return list(CONTROLLERS) if "all" in self.plants else list(self.plants)

    @property
    def kept(self) -> Path:
        """Where what is computed is kept; short trainings apart, or the whole study would take them for its own."""
        return self.folder / "quick" if self.quick else self.folder

    def options_of(self, plant: str) -> tuple[str, ...]:
        """Options of every training of a plant."""
        return ("--quick",) if self.quick else ("--unseen", str(self.unseen), "--episodes", str(EPISODES[plant]))

    def trainings(self, plant: str) -> dict[tuple[str, str], list[Training]]:
        """Of a plant: those of every variant and arm, a list over the seeds."""
        seeds, others = (1, min(self.variant_seeds, 1)) if self.quick else (self.seeds, self.variant_seeds)
        base = self.kept / "runs" / plant

        def every(arm: str, variant: str, count: int, *further: str, folder: str = "") -> list[Training]:
            place = base / (folder or variant.replace(" ", "-").replace("%", "percent")) / arm
            every_option = (*self.options_of(plant), "--unseen-every", "1", *further)
            common = {"recipe": recipe_of(plant), "arm": arm, "variant": variant, "options": every_option}
            return [Training(seed=seed, folder=place / f"seed-{seed}", **common) for seed in range(count)]

        found = {("nominal", arm): every(arm, "nominal", seeds) for arm in ARMS}
        found["nominal", "twinning"][0] = replace(found["nominal", "twinning"][0], figures=True)
        for name, policy in POLICIES.get(plant, {}).items():
            found["nominal", name] = every("twinning", "nominal", seeds, *policy, folder="-".join(policy).strip("-"))
        harder = [variant for variant in VARIANTS if variant != "nominal"] if others else []
        return found | {(variant, arm): every(arm, variant, others) for variant in harder for arm in ARMS}

    def yardsticks(self, plant: str) -> dict[str, Callable[[], dict[str, Any]]]:
        """The oracle and the classical controllers of a plant; each is computed once and kept."""
        place = self.kept / "yardsticks" / plant
        unseen = QUICK_UNSEEN if self.quick else self.unseen
        starts, iterations, evaluations, episodes = (1, 5, 5, 3) if self.quick else (4, 40, 80, 20)
        best = {"unseen": unseen, "starts": starts, "iterations": iterations, "polish": 5 if self.quick else 20}
        tuned = {"unseen": unseen, "episodes": episodes, "evaluations": evaluations}
        tuned |= {"recipe": recipe_of(plant), "options": self.options_of(plant)}
        found = {"oracle": partial(oracle, plant, place / "oracle.json", **best)}
        for name, kind in CONTROLLERS[plant].items():
            found[name] = partial(classical, plant, kind, place / f"{name}.json", **tuned)
        return found

    def gain_line(self, plant: str) -> Callable[[], dict[str, Any]] | None:
        """The cost of a classical controller over its first gain, where that explains something; kept too."""
        if plant not in GAIN_LINES:
            return None
        path = self.kept / "yardsticks" / plant / "gain-line.json"
        unseen = QUICK_UNSEEN if self.quick else self.unseen
        return partial(cost_along_gain, plant, GAIN_LINES[plant], path, unseen=unseen, multiples=MULTIPLES)


def recipe_of(plant: str) -> Path:
    """The recipe of a plant."""
    return Path(__file__).with_name(f"{plant}.py")


def compute(config: Config) -> None:
    """Everything that is not done yet, side by side, with one progress bar."""
    tasks = [task for plant in config.chosen() for task in config.yardsticks(plant).values()]
    tasks += [line for plant in config.chosen() if (line := config.gain_line(plant))]
    groups = [item for plant in reversed(config.chosen()) for item in config.trainings(plant).items()]
    # The plant that takes longest first, and what the other results are measured by before what is made harder.
    for _, group in sorted(groups, key=lambda item: item[0][0] != "nominal"):
        tasks += [training.run for training in group]
    side_by_side(tasks, backend=config.backend, jobs=config.jobs or os.cpu_count() or 1)


def side_by_side(tasks: list[Callable[[], Any]], *, backend: str, jobs: int) -> None:
    """Run tasks through joblib with a progress bar.

    Raises:
        ValueError: if the backend is Ray and there is none.
    """
    if backend == "ray":
        try:
            from ray.util.joblib import register_ray
        except ImportError as error:
            raise ValueError("backend='ray' needs Ray: install the extra, pip install 'rt_torchrl[ray]'.") from error
        register_ray()
    ordered = "list" if backend == "ray" else "generator_unordered"
    running = Parallel(n_jobs=jobs, backend=backend, return_as=ordered)(delayed(task)() for task in tasks)
    for _ in tqdm(running, total=len(tasks), unit="task", desc="study"):
        pass


def entries_of(config: Config, plant: str) -> list[Entry]:
    """Arms, then classical controllers, then the oracle."""
    trainings = config.trainings(plant)
    found = [arm_entry(name, trainings["nominal", name]) for name in (*ARMS, *POLICIES.get(plant, {}))]
    yardsticks = [yardstick_entry(name, task()) for name, task in config.yardsticks(plant).items()]
    return found + yardsticks[1:] + yardsticks[:1]


def harder_of(config: Config, plant: str) -> dict[str, list[Entry]]:
    """Every arm under every variant; with model error the classical controllers too."""
    trainings = config.trainings(plant)
    variants = dict.fromkeys(variant for variant, _ in trainings if variant != "nominal")
    found = {variant: [arm_entry(arm, trainings[variant, arm]) for arm in ARMS] for variant in variants}
    if found:
        tasks = {name: config.yardsticks(plant)[name] for name in CONTROLLERS[plant]}
        found[CHANGED] += [yardstick_entry(name, task()["changed"]) for name, task in tasks.items()]
    return found


def gather(config: Config) -> Results:
    """Everything the report is written from."""
    results = Results({}, {}, {})
    for plant in config.chosen():
        nominal = config.trainings(plant)["nominal", "twinning"]
        results.entries[plant], results.variants[plant] = entries_of(config, plant), harder_of(config, plant)
        results.summaries[plant] = [training.metrics()["summary"] for training in nominal]
    return results


def draw(config: Config, results: Results) -> list[str]:
    """Figures of the study and of the first twinning run of each plant, as Markdown with captions."""
    folder = config.folder / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    drawn = {"learning": charts.learning(results.entries), "robustness": charts.robustness(results.entries)}
    if config.variant_seeds:
        drawn["variants"] = charts.variants(results.entries, results.variants)
        drawn["following"] = charts.following(results.entries, results.variants)
    found = []
    for name, figure in drawn.items():
        figure.savefig(folder / f"{name}.png", dpi=110)
        found.append(page.figure(folder / f"{name}.png", config.folder, report.CAPTIONS[name]))
    for plant in config.chosen():
        if line := config.gain_line(plant):
            charts.gain_line(line(), results.entries[plant]).savefig(folder / f"{plant}_gain_line.png", dpi=110)
            found.append(
                page.figure(folder / f"{plant}_gain_line.png", config.folder, report.GAIN_LINE_CAPTIONS[plant])
            )
        first = config.trainings(plant)["nominal", "twinning"][0].folder / "figures"
        for name, text in (report.RUN_CAPTIONS | report.PLANT_CAPTIONS[plant]).items():
            copy = folder / f"{plant}_{name}.png"
            shutil.copy(first / f"{name}.png", copy)
            found.append(page.figure(copy, config.folder, f"{charts.shown(plant).capitalize()}, seed 0. {text}"))
    return found


def write(config: Config) -> Path:
    """The report: Markdown, HTML, figures and ``study.json``; returns the page."""
    results = gather(config)
    sections = report.sections(results, figures=draw(config, results), quick=config.quick, command=command(config))
    (config.folder / "study.json").write_text(json.dumps(report.numbers(results), indent=2) + "\n")
    return page.write(config.folder, "What reinforcement twinning is worth", sections)[1]


def command(config: Config) -> str:
    """The command that makes this report."""
    plants = " ".join(config.plants)
    size = "--quick" if config.quick else f"--seeds {config.seeds} --variant-seeds {config.variant_seeds}"
    return f"uv run recipes/study.py --plants {plants} {size} --unseen {config.unseen}"


def main(config: Config) -> None:
    compute(config)
    print(f"report in {write(config)}")


if __name__ == "__main__":
    main_of(Config, main)
