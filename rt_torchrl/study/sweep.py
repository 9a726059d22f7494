"""Trainings of one recipe over seeds, and a search over its options with Optuna."""

import contextlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.runs.results import judged_on_the_system
from rt_torchrl.runs.settings import read_settings
from rt_torchrl.study.scheduling import side_by_side
from rt_torchrl.study.training import options_of, require_options, written_in

if TYPE_CHECKING:
    import optuna  # only its types: seeds need no search

LOGARITHMIC = 100.0
"""Ratio of the ends of a range from which on it is searched on a logarithmic scale."""
OWN = ("--seed", "--log-dir", "--resume", "--overwrite", "--threads")
"""Options of a recipe that a sweep gives itself."""


@dataclass(frozen=True, kw_only=True)
class SeededRun:
    """A recipe's run with one seed, on one thread; a task of :func:`side_by_side`.

    Args:
        recipe: path of the recipe.
        seed: seed of the run.
        folder: run folder.
        options: further options of the recipe.
    """

    recipe: Path
    seed: int
    folder: Path
    options: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"the training in {self.folder}"

    def arguments(self) -> list[str]:
        """Options of the recipe; they go on with a run that was interrupted."""
        begun = (self.folder / "checkpoint.pt").exists()
        own = ["--seed", str(self.seed), "--log-dir", str(self.folder), "--threads", "1"]
        return [*own, "--resume" if begun else "--overwrite", *self.options]

    def done(self) -> bool:
        """Whether the run has ended after all of its episodes, or because its callbacks or its patience ended it.

        Raises:
            ValueError: if the results are those of other options.
        """
        if (found := written_in(self.folder)) is None:
            return False
        asked = replace(options_of(self.recipe, self.options), seed=self.seed)
        require_options(self.folder, asked)
        patient = read_settings(self.folder)["patience"] == asked.patience  # another patience may go on
        return len(found["episodes"]) >= asked.episodes or (patient and found["summary"].get("ended") is not None)

    def run(self) -> None:
        """Train, unless it is done. ``training.log`` in the folder takes what the recipe prints.

        Raises:
            ValueError: if the results are there and are those of other options.
            KeyboardInterrupt: if Ctrl-C or SIGTERM ended the training before its last episode.
        """
        if self.done():
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        arguments = self.arguments()
        log = self.folder / "training.log"
        with log.open("w") as said, contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            recipe = load_recipe(self.recipe)
            recipe.main(from_command_line(recipe.Config, arguments))
        if not self.done():
            raise KeyboardInterrupt  # the recipe has taken the signal, and wrote what it had done

    def cost(self) -> float:
        """Mean J_a of the policy that the referee prefers, on the unseen episodes; infinite if it diverges there.

        On a real system of unknown closure it is that of the live policy on its flights after the training.

        Raises:
            ValueError: if the training was judged on its own twin alone.
        """
        summary = json.loads((self.folder / "metrics.json").read_text(encoding="utf-8"))["summary"]
        judged, role = judged_on_the_system(summary)
        found = judged[f"J_a_{role}"]["mean"]
        return float("inf") if found is None else float(found)


@dataclass(frozen=True)
class Searched:
    """An option and the values that a search may give it.

    Args:
        option: name of the option, as the command line has it, without dashes in front.
        low: low end of a range; None for choices.
        high: high end of a range.
        choices: choices, as words of the command line.
    """

    option: str
    low: int | float | None = None
    high: int | float | None = None
    choices: tuple[str, ...] = ()

    @classmethod
    def read(cls, text: str) -> "Searched":
        """From ``option=low..high`` or ``option=one|other``.

        Raises:
            ValueError: if the text is neither.
        """
        option, _, values = text.partition("=")
        ends = values.split("..")
        if option and len(ends) == 2 and all(map(_number, ends)):
            low, high = (int(end) if re.fullmatch(r"[-+]?\d+", end) else float(end) for end in ends)
            if low < high:
                return cls(option.lstrip("-"), low, high)
        elif option and len(values.split("|")) > 1:
            return cls(option.lstrip("-"), choices=tuple(values.split("|")))
        raise ValueError(f"over={text!r} must be option=low..high with low < high, or option=one|other.")

    def drawn(self, trial: "optuna.Trial") -> str:
        """The value of a trial, as a word of the command line."""
        if self.low is None or self.high is None:
            return str(trial.suggest_categorical(self.option, self.choices))
        wide = self.low > 0 and self.high >= LOGARITHMIC * self.low
        if isinstance(self.low, int) and isinstance(self.high, int):
            return str(trial.suggest_int(self.option, self.low, self.high, log=wide))
        return repr(trial.suggest_float(self.option, float(self.low), float(self.high), log=wide))


def _number(text: str) -> bool:
    try:
        return abs(float(text)) < float("inf")
    except ValueError:
        return False


def seeded_runs(recipe: Path, seeds: Sequence[int], folder: Path, options: Sequence[str] = ()) -> list[SeededRun]:
    """One run for each seed, in folders ``seed-SEED``.

    Raises:
        ValueError: if the recipe does not take the options, or an option is one that a sweep gives itself.
    """
    given = {option.split("=")[0].replace("_", "-") for option in options if option.startswith("--")}
    if own := given & set(OWN):
        raise ValueError(f"given holds {', '.join(sorted(own))}, which a sweep gives each run itself; leave it out.")
    return [
        SeededRun(recipe=recipe, seed=seed, folder=folder / f"seed-{seed}", options=tuple(options)) for seed in seeds
    ]


def train_all(runs: Sequence[SeededRun], jobs: int) -> None:
    """Train the runs, several at a time.

    Args:
        runs: runs to train; those that have ended are left as they are.
        jobs: number of processes; 0 for one on each core.

    Raises:
        RuntimeError: after all runs, if some failed.
    """
    side_by_side([[run] for run in runs], jobs=jobs)


def study_in(folder: Path, name: str, *, seed: int) -> "optuna.Study":
    """Optuna's study in a folder, which is made if there is none.

    Raises:
        ValueError: if Optuna is missing.
    """
    try:
        import optuna
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend
    except ImportError as error:
        raise ValueError("trials need Optuna: install the extra, pip install 'rt_torchrl[sweep]'.") from error
    folder.mkdir(parents=True, exist_ok=True)
    storage = JournalStorage(JournalFileBackend(str(folder / "study.log")))
    sampler = optuna.samplers.TPESampler(seed=seed)
    return optuna.create_study(study_name=name, storage=storage, load_if_exists=True, sampler=sampler)


def search(
    recipe: Path,
    over: Sequence[Searched],
    seeds: Sequence[int],
    folder: Path,
    *,
    trials: int,
    jobs: int,
    options: Sequence[str] = (),
) -> "optuna.Study":
    """Search options for the least mean cost over the seeds; a search in the same folder goes on.

    A trial whose trainings fail counts as failed, and the search goes on without it.

    Args:
        recipe: path of the recipe.
        over: options to search and their values.
        seeds: seeds of the trainings of each trial.
        folder: folder of the trials, and of ``study.log``, Optuna's journal.
        trials: number of further trials.
        jobs: number of processes; 0 for one on each core.
        options: options that every training has.

    Raises:
        ValueError: if Optuna is missing.
    """
    study = study_in(folder, recipe.stem, seed=len(over))

    def objective(trial: "optuna.Trial") -> float:
        chosen: list[str] = [word for one in over for word in (f"--{one.option}", one.drawn(trial))]
        runs = seeded_runs(recipe, seeds, folder / f"trial-{trial.number}", [*options, *chosen])
        train_all(runs, jobs)
        costs = [run.cost() for run in runs]
        return sum(costs) / len(costs)

    study.optimize(objective, n_trials=trials, catch=(RuntimeError,))
    return study


def trials_table(study: Any, most: int = 10) -> str:
    """The best trials as text, with what each option was.

    Args:
        study: Optuna's study.
        most: greatest number of trials.
    """
    done = sorted((one for one in study.trials if one.value is not None), key=lambda one: one.value)
    lines = [f"{'trial':>7}{'J_a':>12}   options"]
    for one in done[:most]:
        shown = " ".join(f"--{name} {value}" for name, value in one.params.items())
        lines.append(f"{one.number:>7}{one.value:>12.5g}   {shown}")
    failed = len(study.trials) - len(done)
    return "\n".join([*lines, *([f"{failed} trials failed; see training.log in their folders"] if failed else [])])
