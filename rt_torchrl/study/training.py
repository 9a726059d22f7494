"""One training of the study, as the command of its recipe."""

import contextlib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from rt_torchrl.interruption import Interrupted
from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.settings import FILE, differences
from rt_torchrl.steps.config import Arm
from rt_torchrl.study.json_file import read_json

CHANGED = "model error"
"""The variant in which the real system differs from what the twin assumes."""
VARIANTS: dict[str, tuple[str, ...]] = {
    "nominal": (),
    "noise 0.5 %": ("--noise", "0.005"),
    "noise 1 %": ("--noise", "0.01"),
    "noise 5 %": ("--noise", "0.05"),
    CHANGED: ("--model-error",),
}
"""Variants of a training by name, each as options of every recipe."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """A recipe's run with one arm, seed and variant. Its command can be repeated by hand.

    It runs in the process that calls it, so that the next training of the same plant finds everything compiled.

    Args:
        recipe: path of the recipe.
        arm: arm of the algorithm.
        seed: seed of the run.
        variant: key of ``VARIANTS``.
        folder: run folder.
        episodes: number of real episodes.
        options: further options of the recipe.
    """

    recipe: Path
    arm: Arm
    seed: int
    variant: str
    folder: Path
    episodes: int
    options: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise ValueError(f"variant={self.variant!r} does not exist; choose one of {', '.join(VARIANTS)}.")

    def __str__(self) -> str:
        return f"the training in {self.folder}"

    @property
    def plant(self) -> str:
        return self.recipe.stem

    def arguments(self) -> list[str]:
        """Options of the recipe. They resume a run that was interrupted after its first episode."""
        begun = (self.folder / "checkpoint.pt").exists()
        place = ["--log-dir", str(self.folder), "--resume" if begun else "--overwrite"]
        return ["--seed", str(self.seed), *self._usual(), *place, *VARIANTS[self.variant], *self.options]

    def _usual(self) -> list[str]:
        options = ["--twinning.arm", self.arm, "--episodes", str(self.episodes)]
        # The study compares costs with the start of each seed, not with random starts.
        return [*options, "--figures-every", "0", "--untrained", "0", "--threads", "1", "--no-figures"]

    def command(self) -> str:
        """The same as a command line."""
        return " ".join(["uv run", str(self.recipe), *self.arguments()])

    def done(self) -> bool:
        """Whether the results of all episodes are there.

        Raises:
            ValueError: if the results are those of other options.
        """
        if self._results() is None:
            return False
        self._require_own_options()
        return True

    def _require_own_options(self) -> None:
        """Refuse results that a page would mix with those of these options; results by hand have no options."""
        if not (self.folder / FILE).is_file():
            return
        of_every_seed = (*self._usual(), *VARIANTS[self.variant], *self.options)
        require_options(self.folder, replace(options_of(self.recipe, of_every_seed), seed=self.seed))

    def run(self) -> None:
        """Train, unless the results are there. ``training.log`` in the folder takes what the recipe prints.

        Raises:
            ValueError: if the results are there and are those of other options.
            RuntimeError: if the recipe fails, with what it said, or ends without the results of all episodes.
            KeyboardInterrupt: if Ctrl-C or SIGTERM ended the training before its last episode.
        """
        if self.done():
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        # The command is taken before the start: a training that fails later leaves a checkpoint, which changes it.
        log, command, arguments = self.folder / "training.log", self.command(), self.arguments()
        with log.open("w") as output, contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            print(command, flush=True)
            if (self.folder / "metrics.json").exists():
                print("the results in this folder are damaged or incomplete; this training replaces them", flush=True)
            try:
                recipe = load_recipe(self.recipe)
                recipe.main(from_command_line(recipe.Config, arguments))
            except Interrupted as error:
                raise KeyboardInterrupt from error  # it came before the first episode was done
            except (Exception, SystemExit) as error:
                raise RuntimeError(f"{command} failed; see {log}: {error}") from error
        if self._cut_short():
            raise KeyboardInterrupt  # the recipe has taken the signal, and no other training must follow
        if not self.done():
            raise RuntimeError(f"{command} ended without the results of {self.episodes} episodes; see {log}")

    def metrics(self) -> dict[str, Any]:
        """Content of its ``metrics.json``.

        Raises:
            ValueError: if the file is missing or damaged, or holds the results of fewer or more episodes.
        """
        if (found := self._results()) is None:
            raise ValueError(
                f"{self.folder} holds no results of a training of {self.episodes} episodes; run the study again, it "
                "computes what is missing."
            )
        return found

    def _cut_short(self) -> bool:
        # An interrupted run writes results, too, of the episodes that it has done.
        written = written_in(self.folder)
        return written is not None and len(written["episodes"]) < self.episodes

    def _results(self) -> dict[str, Any] | None:
        written = written_in(self.folder)
        return written if written is not None and len(written["episodes"]) == self.episodes else None


def written_in(folder: Path) -> dict[str, Any] | None:
    """Content of the ``metrics.json`` of a run, whether or not it was cut short; None if it is missing or damaged."""
    found = read_json(folder / "metrics.json") or {}
    sound = isinstance(found.get("summary"), dict) and isinstance(found.get("episodes"), list)
    return found if sound else None


def require_options(folder: Path, asked: RunConfig) -> None:
    """Refuse results of other options than these.

    Raises:
        ValueError: if the run in the folder has other options, or the folder is no run folder.
    """
    if found := differences(folder, asked):
        raise ValueError(
            f"{folder} holds the results of other options: {'; '.join(found)}. Give the options of the run, or another "
            "folder; the training of a folder that you remove is made again."
        )


@cache
def options_of(recipe: Path, arguments: tuple[str, ...]) -> RunConfig:
    """The configuration of a recipe's command line, which takes some tenths of a second to read."""
    return from_command_line(load_recipe(recipe).Config, arguments)
