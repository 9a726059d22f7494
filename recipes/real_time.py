"""Rehearse model predictive control on a fitted twin in real time, behind a safety layer."""

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

if __name__ == "__main__":
    print("loading PyTorch and TorchRL", file=sys.stderr)  # at once, because this takes seconds

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from tyro.conf import Positional

from rt_torchrl import (
    ExplorationConfig,
    LoadedRun,
    Plant,
    PredictiveControl,
    Reading,
    RealSystem,
    SafetyConfig,
    SafetyLayer,
    check_options,
    load_run,
    main_of,
)
from rt_torchrl.runs.results_file import make_folder, write_results
from rt_torchrl.runs.run_config import plant_of
from rt_torchrl.systems.collectors import EpisodeCollector
from rt_torchrl.systems.exploration import LivePolicy
from rt_torchrl.systems.wall_clock import WallClock

SHARE = 0.8
"""Share of the time between two plans that a solve may take by default; the rest is for what comes around it."""


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

    run: Annotated[Path, Positional]
    seconds: float | None = None
    deadline: float | None = None
    seed: int = 0
    folder: Path = Path("runs/real_time")

    def __post_init__(self):
        check_options(self)
        for argument in ("seconds", "deadline"):
            value = getattr(self, argument)
            if value is not None and not value > 0.0:
                raise ValueError(f"{argument}={value} s must be positive.")
        if self.seed < 0:
            raise ValueError(f"seed={self.seed} must not be negative.")


def main(config: Config) -> None:
    torch.set_num_threads(1)
    make_folder("folder", config.folder)
    run = load_run(config.run)
    plant = plant_of(run.config if config.seconds is None else dataclasses.replace(run.config, horizon=config.seconds))
    found = rehearsed(plant, controller(run, plant, config.deadline), run, config)
    path = write_results(config.folder / "real_time.json", {"config": config, **found})
    for name, value in found.items():
        print(f"{name.replace('_', ' '):<32}{value:.6g}")
    print(f"results in {path}")


def controller(run: LoadedRun, plant: Plant, deadline: float | None) -> PredictiveControl:
    """Model predictive control with a deadline, on the closure of a training."""
    options = run.config.twinning.planner.receding_horizon
    period = options.period or options.hold or plant.dt
    options = dataclasses.replace(options, deadline=SHARE * period if deadline is None else deadline)
    found, acted = PredictiveControl(run.config.believed() or plant, run.closure, options), run.policy("model_based")
    if isinstance(acted, PredictiveControl):
        found.load_state_dict(acted.state_dict())
    return found


def rehearsed(plant: Plant, policy: PredictiveControl, run: LoadedRun, config: Config) -> dict[str, float]:
    """Fly an episode in real time, and say what was late."""
    clock, log = WallClock(plant), config.folder / "safety.jsonl"
    log.unlink(missing_ok=True)
    # An observation comes at the end of its interval; half an interval later the machine has stopped to answer.
    limits = SafetyConfig(interval=plant.dt, deadline=1.5 * plant.dt, log=log)
    guarded = SafetyLayer(clock.environment(seed=config.seed), limits, fallback=Fallback(plant, run))
    readings = {name: Reading(keys=(name,)) for name in ("state", "exogenous", "applied")}
    system = RealSystem(guarded, plant, **readings, closure=plant.closure, seed=config.seed)
    actor = LivePolicy(plant, policy, ExplorationConfig(), generator=torch.Generator())
    actor.begin(policy, strength=0.0)
    episode = EpisodeCollector(system, actor, plant).rollout()
    solves = 1e3 * np.array([solve.seconds for solve in policy.solves])
    found = {
        "J_a": -episode["next", "reward"].mean().item(),
        "intervals": float(plant.n_steps),
        "solves": float(len(solves)),
        "late_solves": float(sum(solve.late for solve in policy.solves)),
        "late_actions": float(clock.late),
        "safety_events": float(len(guarded.report.events)),
    }
    system.close()
    return found | times("solve", solves) | times("answer", 1e3 * np.array(clock.answers))


def times(name: str, milliseconds: np.ndarray) -> dict[str, float]:
    """Median, 99th percentile and greatest of some times [ms]."""
    numbers: dict[str, Any] = {"median": np.median(milliseconds), "p99": np.percentile(milliseconds, 99)}
    return {f"{name}_{key}_ms": float(value) for key, value in (numbers | {"max": milliseconds.max()}).items()}


class Fallback:
    """The model-free policy of a training, in the place of a controller whose observation is faulty.

    Args:
        plant: the plant.
        run: the training.
    """

    def __init__(self, plant: Plant, run: LoadedRun):
        self.plant, self.policy = plant, run.policy("model_free")

    def __call__(self, reported: TensorDictBase) -> Tensor:
        seen = self.plant.observe(reported["time"][0], reported["state"], reported["exogenous"])
        return self.policy(seen)


if __name__ == "__main__":
    main_of(Config, main)
