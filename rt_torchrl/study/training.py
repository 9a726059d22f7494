"""One training of the study, as the command of its recipe."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rt_torchrl.algorithm import Arm

VARIANTS: dict[str, tuple[str, ...]] = {
    "nominal": (),
    "noise 0.5 %": ("--noise", "0.005"),
    "noise 1 %": ("--noise", "0.01"),
    "noise 5 %": ("--noise", "0.05"),
    "model error": ("--model-error",),
}
"""What is made harder, by name, as options of every recipe."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """A recipe's run with one arm, seed and variant; a process of its own, so that it can be repeated by hand.

    Args:
        recipe: path of the recipe.
        arm: of the algorithm.
        seed: of the run.
        variant: key of ``VARIANTS``.
        folder: run folder.
        options: further options of the recipe.
    """

    recipe: Path
    arm: Arm
    seed: int
    variant: str
    folder: Path
    options: tuple[str, ...] = ()

    def __post_init__(self):
        if self.variant not in VARIANTS:
            raise ValueError(f"variant={self.variant!r} does not exist; choose one of {', '.join(VARIANTS)}.")

    @property
    def plant(self) -> str:
        return self.recipe.stem

    def command(self) -> list[str]:
        """The command line; goes on with a run that was interrupted after its first episode."""
        begun = (self.folder / "checkpoint.pt").exists()
        options = ["--seed", str(self.seed), "--twinning.arm", self.arm, "--log-dir", str(self.folder)]
        options += ["--figures-every", "0", "--threads", "1", "--resume" if begun else "--overwrite"]
        return [sys.executable, str(self.recipe), *options, *VARIANTS[self.variant], *self.options]

    def done(self) -> bool:
        """Whether its results are there."""
        return (self.folder / "metrics.json").exists()

    def run(self) -> None:
        """Train, unless that is done; what the recipe prints goes to ``training.log`` in the folder.

        Raises:
            RuntimeError: if the recipe fails; ends with the last line that it printed.
        """
        if self.done():
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        log = self.folder / "training.log"
        with log.open("w") as output:
            code = subprocess.run(self.command(), stdout=output, stderr=subprocess.STDOUT).returncode
        if code:
            last = (log.read_text().strip().splitlines() or ["no output"])[-1]
            raise RuntimeError(f"{' '.join(self.command())} failed with exit status {code}; see {log}: {last}")

    def metrics(self) -> dict[str, Any]:
        """Its ``metrics.json``."""
        return json.loads((self.folder / "metrics.json").read_text())
