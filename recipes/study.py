"""Arms of the algorithm on several systems over many seeds: one table, one figure, and the best that is possible."""

import contextlib
import dataclasses
import functools
import hashlib
import json
import math
import re
import shlex
import statistics
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import rt_torchrl as rt

rt.begin_loading(__name__)

import torch
from pydantic import Field

from rt_torchrl.atomic_file import make_folder, read_json, write_atomically, write_json
from rt_torchrl.evaluation.optimum import exact_optimum
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.interruption import Interrupted, termination_as_interrupt
from rt_torchrl.options import AtLeastOne, Count
from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.runs.compare import FinishedRun, Row, markdown, with_interval
from rt_torchrl.runs.run_config import MakesPlant, physics_of, plant_of
from rt_torchrl.runs.settings import FILE, HARMLESS, as_written, differences, read_settings, settings_of, task_of
from rt_torchrl.steps.config import Arm

PLANTS = ("wind_turbine", "flapping_wing", "cryogenic_tank")
ARMS: tuple[Arm, ...] = ("twinning", "model_based", "model_free")
RESERVED = ("--seed", "--log-dir", "--resume", "--threads", "--unseen-every", "--config")
"""Options that the study gives every run itself."""
COMMON = ("--threads", "1", "--unseen-every", "1", "--no-figures")
QUICK_EFFORT = {"starts": 1, "approach": 100, "iterations": 20, "polish": 5}
"""Effort of the search for the optimum with ``quick``."""


@rt.configuration
class Config:
    """Train arms on systems over seeds, and compare their costs with classical controllers and the optimum.

    Every training is a run in SYSTEM/ARM/seed-SEED of the folder. Finished ones are kept, so that the same command goes
    on where it was interrupted. The results are study.md, study.json and study.png.

    Args:
        systems: recipes with options in quotation marks, such as "wind_turbine --unknown pitch", perhaps with a name,
            as in "pitch=wind_turbine --unknown pitch"; by default the three plants, or with quick the turbine.
        arms: options that the systems are trained with, each with a name, such as
            "sac=--twinning.learner.algorithm sac", or an arm of the algorithm: twinning, model_based or model_free.
            The others are compared with the first.
        seeds: number of trainings of each arm on each system, with the seeds from 0 on.
        given: options of every training, in one word with the option, as in --given="--episodes 10 --unseen 100".
        optimum: whether to seek the least cost of the class of policies, by exact gradients on the true system.
        jobs: number of trainings side by side, each with one thread; 0 for one on each core.
        backend: where they run: loky for processes on this machine, or ray for the cluster that RAY_ADDRESS names,
            whose machines share the folder.
        quick: make two seeds of small trainings.
        runs: folders of finished runs of one plant, which are compared instead of training; those that differ in
            nothing but the seed are one row. The results need a folder that holds no study of trainings.
        log_dir: folder of the runs and of the results.
    """

    systems: tuple[str, ...] = ()
    arms: Annotated[tuple[str, ...], Field(min_length=1)] = ARMS
    seeds: AtLeastOne = 5
    given: str = ""
    optimum: bool = True
    jobs: Count = 0
    backend: Literal["loky", "ray"] = "loky"
    quick: bool = False
    runs: tuple[Path, ...] = ()
    log_dir: Path = Path("runs/study")

    def systems_by_name(self) -> dict[str, tuple[Path, list[str]]]:
        """Recipe and options of each system."""
        systems = []
        for text in self.systems or (PLANTS[:1] if self.quick else PLANTS):
            name, words = named(text)
            if not words:
                raise ValueError(f"systems: {text!r} names no recipe; write RECIPE OPTIONS or NAME=RECIPE OPTIONS.")
            recipe = Path(words[0]) if words[0].endswith(".py") else Path(__file__).with_name(f"{words[0]}.py")
            usual = re.sub(r"[^\w.+-]+", "-", "-".join(word.lstrip("-") for word in (recipe.stem, *words[1:])))
            systems.append((name or usual, (recipe, words[1:])))
        return by_name("systems", systems)

    def arms_by_name(self) -> dict[str, list[str]]:
        """Options of each arm."""
        arms = [(text, ["--twinning.arm", text]) if text in ARMS else named(text) for text in self.arms]
        for text, (name, _) in zip(self.arms, arms, strict=True):
            if name is None:
                raise ValueError(f"arms: {text!r} has no name; write NAME=OPTIONS, or one of {', '.join(ARMS)}.")
        return by_name("arms", arms)

    def trainings(self) -> "dict[tuple[str, str], list[Training]]":
        """The trainings by system and arm, over the seeds.

        Raises:
            ValueError: if a recipe does not exist or refuses its options, or an option is one that the study gives
                itself.
        """
        given, arms = [*shlex.split(self.given), *(["--quick"] if self.quick else [])], self.arms_by_name()
        trainings = {}
        for system, (recipe, of_system) in self.systems_by_name().items():
            for arm, of_arm in arms.items():
                words = (*of_system, *given, *of_arm)
                if reserved := ", ".join(word for word in words if word.split("=")[0].replace("_", "-") in RESERVED):
                    raise ValueError(f"{reserved}: the study gives these to each training itself; leave it out.")
                folder = self.log_dir / system / arm
                trainings[system, arm] = [
                    Training(recipe, words, seed, folder / f"seed-{seed}")
                    for seed in range(min(self.seeds, 2) if self.quick else self.seeds)
                ]
                config = trainings[system, arm][0].config()  # a mistake ends it here and not in every training
                if isinstance(config, MakesPlant):
                    config.plant()
                if task_of(as_written(config)) != task_of(as_written(trainings[system, next(iter(arms))][0].config())):
                    raise ValueError(f"arm {arm!r} of {system!r} is of another task; make it a system of its own.")
        return trainings


def named(text: str) -> tuple[str | None, list[str]]:
    """Name and words of ``NAME=WORDS``, or None and the words."""
    name = re.match(r"(\w[\w.+-]*)=", text)
    return (name[1], shlex.split(text[name.end() :])) if name else (None, shlex.split(text))


def by_name(argument: str, entries: Sequence[tuple[Any, Any]]) -> dict[str, Any]:
    """Entries by their names, each of which has to be its own."""
    names = [name for name, _ in entries]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{argument}: {name!r} stands for two; give names, as in NAME=OPTIONS.")
    return dict(entries)


@functools.cache
def options_of(recipe: Path, words: tuple[str, ...]) -> rt.RunConfig:
    """The options of a recipe's command line, which takes some tenths of a second to read."""
    return from_command_line(load_recipe(recipe).Config, words)


@dataclass(frozen=True)
class Training:
    """A run of a recipe; it runs in the process that calls it, so that the next one finds everything compiled.

    Args:
        recipe: file of the recipe.
        words: options of the recipe.
        seed: seed of the run.
        folder: run folder.
    """

    recipe: Path
    words: tuple[str, ...]
    seed: int
    folder: Path

    def config(self) -> rt.RunConfig:
        """The options of the run."""
        return dataclasses.replace(options_of(self.recipe, (*COMMON, *self.words)), seed=self.seed, log_dir=self.folder)

    def finished(self) -> bool:
        """Whether all episodes are done.

        Raises:
            ValueError: if the folder holds a run of other options, or of more episodes.
        """
        if not (self.folder / FILE).is_file():
            return False
        config = self.config()
        mismatches = differences(self.folder, config, HARMLESS - {"unseen_every"})
        recipe, file = read_settings(self.folder).get("recipe"), settings_of(config, "")["recipe"]["file"]
        if recipe and recipe.get("file") != file:
            mismatches.append(f"the recipe is {file} here and was {recipe.get('file')} in the run")
        metrics = known(self.folder / "metrics.json")
        done, episodes = len((metrics or {}).get("episodes", [])), config.effective().episodes
        if done > episodes:
            mismatches.append(f"episodes is {episodes} here and was {done} in the run")
        if mismatches:
            raise ValueError(
                f"{self.folder} holds a run of other options: {'; '.join(mismatches)}. Give its options or another "
                "log_dir, or remove the folder."
            )
        return metrics is not None and (done == episodes or metrics["summary"].get("ended") is not None)

    def run(self) -> None:
        """Train, or go on with what is there. ``training.log`` in the folder takes all output, and a traceback."""
        if self.finished():
            return
        config = dataclasses.replace(self.config(), resume=(self.folder / FILE).is_file())
        self.folder.mkdir(parents=True, exist_ok=True)
        log = (self.folder / "training.log").open("a", encoding="utf-8")
        with log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
            print(shlex.join([str(self.recipe), *COMMON, *self.words, "--seed", str(self.seed)]), flush=True)
            try:
                load_recipe(self.recipe).main(config)
            except Exception:
                traceback.print_exc()
                raise
        if self.finished():
            return
        if known(self.folder / "metrics.json") is None:
            raise RuntimeError("the recipe has ended without results; see training.log")
        raise KeyboardInterrupt  # the run has taken the signal, and kept its episodes


@dataclass(frozen=True)
class Search:
    """The search for the least cost of a class of policies, kept as JSON with what it depends on.

    Args:
        recipe: file of the recipe.
        words: options of the recipe.
        effort: how thoroughly it is sought.
        place: folder of the files.
    """

    recipe: Path
    words: tuple[str, ...]
    effort: dict[str, int]
    place: Path

    def of(self) -> dict[str, Any]:
        """What the cost depends on: recipe, task, unseen episodes, effort and class of policies.

        What policies observe may depend on options of every run, such as the preset.
        """
        config = options_of(self.recipe, self.words).effective()
        of = {"recipe": str(self.recipe.resolve()), "effort": self.effort, "unseen": config.unseen}
        of |= {"policy": config.policy, "hidden": config.hidden}
        of |= {"observations": [signal.name for signal in physics_of(config).observations]}
        return of | task_of(as_written(config))

    @functools.cached_property
    def path(self) -> Path:
        """The file."""
        digest = hashlib.sha256(json.dumps(self.of(), sort_keys=True).encode()).hexdigest()
        return self.place / f"{self.recipe.stem}-{digest[:12]}.json"

    def finished(self) -> bool:
        """Whether the cost is kept."""
        return known(self.path) is not None

    def run(self) -> None:
        """Compute the cost, unless it is kept."""
        if self.finished():
            return
        torch.set_num_threads(1)
        config = options_of(self.recipe, self.words).effective()
        plant, physics = plant_of(config), physics_of(config)
        episodes = UnseenEpisodes(plant, config.unseen)
        episodes.physics = physics
        best = exact_optimum(episodes, functools.partial(config.make_policy, physics), **self.effort)
        optimum = {"J_a": best.cost, "J_a_by_gradients": best.by_gradients, "J_a_of_each_start": best.costs}
        self.place.mkdir(parents=True, exist_ok=True)
        write_json(self.path, {"of": self.of(), **optimum})


def known(path: Path) -> dict[str, Any] | None:
    """The object in a JSON file; None if the file is missing or damaged."""
    try:
        return read_json(path)
    except ValueError:
        return None


def in_a_worker(file: str, kind: str, task: dict[str, Any]) -> str | None:
    """Run a task of this file in another process, and return what went wrong; ``interrupted`` after Ctrl-C.

    The process imports the file: what a script defines has no name there.
    """
    from rt_torchrl.runs.settings import module_of

    try:
        getattr(module_of(Path(file)), kind)(**task).run()
    except (Interrupted, KeyboardInterrupt):
        return "interrupted"
    except (Exception, SystemExit) as error:
        return f"{task.get('folder', task['words'])}: {type(error).__name__}: {error}"
    return None


def run_all(tasks: Sequence[Training | Search], *, jobs: int = 0, backend: str = "loky") -> list[str]:
    """Run tasks side by side, with one progress line; one that fails stops no other.

    Args:
        tasks: the tasks; those that are finished are left as they are.
        jobs: number of processes; 0 for one on each core.
        backend: backend of joblib.

    Returns:
        What went wrong.

    Raises:
        ValueError: before any work, if a folder holds a run of other options.
        KeyboardInterrupt: after Ctrl-C or SIGTERM.
    """
    from joblib import Parallel, delayed  # here, because --help needs none of it
    from tqdm import tqdm

    if backend == "ray":
        from ray.util.joblib import register_ray  # of the extra cluster

        register_ray()
    missing, failures = [task for task in tasks if not task.finished()], []
    if not missing:
        return []
    returned = "list" if backend == "ray" else "generator_unordered"
    workers = Parallel(n_jobs=jobs or -1, backend=backend, batch_size=1, return_as=returned)
    calls = [delayed(in_a_worker)(__file__, type(task).__name__, dataclasses.asdict(task)) for task in missing]
    with termination_as_interrupt(), tqdm(total=len(tasks), initial=len(tasks) - len(missing), desc="study") as bar:
        try:
            for failure in workers(calls):
                if failure == "interrupted":
                    raise KeyboardInterrupt
                if failure:
                    failures.append(failure)
                    bar.write(failure)
                bar.update()
        except KeyboardInterrupt:
            bar.write(f"interrupted: {bar.n} of {len(tasks)} are finished; the same command goes on")
            raise
    return failures


def overview(comparisons: Sequence[rt.Comparison], key: str) -> str:
    """Ratios of every arm to the first one by system, and their geometric mean over the systems, as Markdown."""
    first = comparisons[0].rows[0].name
    numbers = {table.title: table.numbers()["rows"] for table in comparisons if table.rows[0].name == first}
    arms = list(dict.fromkeys(arm for rows in numbers.values() for arm in rows))[1:]
    lines = [
        (system, {arm: with_interval(rows.get(arm, {}).get(key)) for arm in arms}) for system, rows in numbers.items()
    ]
    ratios = {arm: [rows[arm][key]["ratio"] for rows in numbers.values() if rows.get(arm, {}).get(key)] for arm in arms}
    means = {arm: f"{statistics.geometric_mean(of):.3f} ({len(of)})" if of else "" for arm, of in ratios.items()}
    return markdown([*lines, ("geometric mean (systems)", means)])


def write(config: Config, comparisons: Sequence[rt.Comparison]) -> str:
    """Write study.md, study.json and study.png, and return the text."""
    from rt_torchrl.figures import save_figure
    from rt_torchrl.runs.compare import comparison_figure

    sections = []
    if max(len(comparison.rows) for comparison in comparisons) > 1:
        first = comparisons[0].rows[0].name
        sections += [f"## J_a at the end over that of {first}", overview(comparisons, "J_a_ratio")]
        sections += [f"## Σ J_a of the real episodes over that of {first}", overview(comparisons, "paid_ratio")]
    for comparison in comparisons:
        sections += [f"## {comparison.title}", comparison.table()]
    text = "\n\n".join(sections) + "\n"
    write_atomically(config.log_dir / "study.md", text.encode())
    systems = {comparison.title: comparison.numbers() for comparison in comparisons}
    write_json(config.log_dir / "study.json", {"config": config, "systems": systems})
    figure = comparison_figure(comparisons, "$J_a$ of the live policy; line: median of the seeds, band: their range")
    save_figure(figure, config.log_dir / "study.png")
    return text


def studied(config: Config) -> tuple[list[rt.Comparison], list[str]]:
    """Train what is missing; return the comparison of each system, and what went wrong."""
    trainings, pool = config.trainings(), {"jobs": config.jobs, "backend": config.backend}
    failures = run_all([training for group in trainings.values() for training in group], **pool)
    searches = {}
    for key, group in trainings.items() if config.optimum else ():
        places = {FinishedRun.read(training.folder).place for training in group if training.finished()}
        # Of a real system that nobody simulates, no gradients are known.
        if places == {"simulation"} and isinstance(group[0].config(), MakesPlant):
            effort = QUICK_EFFORT if config.quick else {}
            searches[key] = Search(group[0].recipe, group[0].words, effort, config.log_dir / "optima")
    failures += run_all(list({search.path: search for search in searches.values()}.values()), **pool)
    return comparisons_of(trainings, searches), failures


def comparisons_of(
    trainings: "dict[tuple[str, str], list[Training]]", searches: "dict[tuple[str, str], Search]"
) -> list[rt.Comparison]:
    """The finished runs of each system by arm, beside the optimum.

    The optimum of a class of policies is the least cost that anybody has found: the search by gradients, or a run that
    ended with a policy of the class.
    """
    finished = {
        key: [FinishedRun.read(training.folder) for training in group if training.finished()]
        for key, group in trainings.items()
    }
    least: dict[Path, float] = {}
    for key, search in searches.items():
        if finished[key] and (kept := known(search.path)):
            path, config = search.path, trainings[key][0].config()
            cost = math.inf if kept["J_a"] is None else kept["J_a"]
            # Model predictive control in the place of the model-based policy is of another class.
            plans = config.twinning.planner.method == "receding_horizon"
            of_class = (run.cost for run in finished[key] if run.live == "model_free" or not plans)
            least[path] = min([least.get(path, cost), *of_class])
    rows: dict[str, list[Row]] = {}
    for (system, arm), runs in finished.items():
        search = searches.get((system, arm))
        if runs:
            optimum = None if search is None else least.get(search.path)
            rows.setdefault(system, []).append(Row(name=arm, runs=runs, optimum=optimum))
    return [rt.Comparison(system, of_system) for system, of_system in rows.items()]


def main(config: Config) -> None:
    make_folder("log_dir", config.log_dir)
    before = known(config.log_dir / "study.json")
    if config.runs and before is not None and not before["config"]["runs"]:
        raise ValueError(f"log_dir={config.log_dir} holds a study of trainings; give the comparison another folder.")
    comparisons, failures = ([rt.compare_runs(config.runs)], []) if config.runs else studied(config)
    if comparisons:
        print(write(config, comparisons))
        print(f"study.md, study.json and study.png in {config.log_dir}")
    if failures:
        raise ValueError("\n".join([f"{len(failures)} failed, the others are kept:", *failures]))


if __name__ == "__main__":
    rt.main_of(Config, main)
