"""Rehearse model predictive control on a fitted twin in real time, behind a safety layer."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import torch
import tyro

from rt_torchrl import check_options, load_run, main_of
from rt_torchrl.runs.configured_plant import physics_of, plant_of
from rt_torchrl.runs.results_file import make_folder, write_results


@dataclass(frozen=True, kw_only=True)
class Config:
    """Let model predictive control act in real time, on the closure that a training has found.

    The plant is simulated with its true closure and does not wait: an episode takes as long as it says. The safety
    layer's fallback is the training's model-free policy.

    Args:
        run: run folder of a training; if model predictive control did not act in it, its options are those of the
            training's planner, and its forecast holds what is measured.
        seconds: length of the episode [s]; by default that of the training's episodes.
        deadline: longest wall-clock time of a solve [s]; after it the last plan goes on. By default 0.8 of the time
            between two plans.
        seed: seed of the episode's initial state and disturbance.
        folder: folder of the results, real_time.json, and of the events of the safety layer, safety.jsonl.
    """

    run: Annotated[Path, tyro.conf.Positional]
    seconds: float | None = None
    deadline: float | None = None
    seed: int = 0
    folder: Annotated[Path, tyro.conf.arg(name="log-dir", aliases=("--folder",))] = Path("runs/real_time")

    def __post_init__(self):
        check_options(self)
        for argument in ("seconds", "deadline"):
            value = getattr(self, argument)
            if value is not None and not value > 0.0:
                raise ValueError(f"{argument}={value} s must be positive.")
        if self.seed < 0:
            raise ValueError(f"seed={self.seed} must not be negative.")


def main(config: Config) -> None:
    # Here, because --help need not wait for TorchRL.
    from rt_torchrl.runs.rehearsal import controller, rehearsed

    torch.set_num_threads(1)
    make_folder("folder", config.folder)
    run = load_run(config.run)
    options = run.config if config.seconds is None else dataclasses.replace(run.config, horizon=config.seconds)
    plant, physics = plant_of(options), physics_of(options)
    policy = controller(run, physics, config.deadline)
    found = rehearsed(policy, run, plant, physics, seed=config.seed, log=config.folder / "safety.jsonl")
    path = write_results(config.folder / "real_time.json", {"config": config, **found})
    for name, value in found.items():
        print(f"{name.replace('_', ' '):<24}{value:.6g}")
    print(f"results in {path}")


if __name__ == "__main__":
    main_of(Config, main)
