"""What it is worth to act while learning: synchronous against asynchronous trainings of the same real time."""

import dataclasses
from pathlib import Path

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import numpy as np
from wind_turbine import Config as Turbine

from rt_torchrl import OperationConfig, configuration, main_of, require_finished
from rt_torchrl.atomic_file import make_folder, write_results
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController

HOUR = 3600.0


@configuration
class Config:
    """Compare the costs of synchronous and asynchronous trainings of a wind turbine over the same real time.

    A synchronous training lets the turbine's former controller act while it learns. An asynchronous one lets its own
    policies act, and hands each new policy over when it is ready: on the simulated clock, with the learner's time as
    the synchronous training of the same seed has measured it.

    Args:
        hours: real time of each training [h of the turbine].
        seeds: seeds of the trainings.
        pace: seconds of the turbine for each second of the learner; 1 for a turbine, more for what a faster machine
            would see.
        horizon: length of an episode, and of a window [s].
        threads: number of threads of the learner.
        quick: whether to make small updates of the model-free policy.
        log_dir: folder of the trainings and of the results, asynchronous.json.
    """

    hours: float = 4.0
    seeds: tuple[int, ...] = (0, 1, 2)
    pace: float = 1.0
    horizon: float = 600.0
    threads: int = 1
    quick: bool = False
    log_dir: Path = Path("runs/asynchronous")

    def __post_init__(self):
        if not self.seeds or min(self.seeds) < 0:
            raise ValueError(f"seeds={self.seeds} must be at least one, and none negative.")
        if not self.pace > 0.0:
            raise ValueError(f"pace={self.pace} must be positive.")
        if not self.hours * HOUR >= 3.0 * self.horizon:
            raise ValueError(f"hours={self.hours} h must be at least three horizons of {self.horizon:g} s.")

    @property
    def windows(self) -> int:
        """Number of whole windows in the real time."""
        return int(self.hours * HOUR / self.horizon)


def trained(config: Config, seed: int, kind: str, **options) -> list[dict]:
    """The records of a training's episodes."""
    from rt_torchrl import Run

    usual = Turbine().defaults()
    learner = dataclasses.replace(usual.twinning.learner, critic_iterations=200, actor_iterations=200)
    twinning = dataclasses.replace(usual.twinning, learner=learner) if config.quick else usual.twinning
    run = dataclasses.replace(
        usual,
        seed=seed,
        horizon=config.horizon,
        episodes=config.windows,
        threads=config.threads,
        twinning=twinning,
        figures=False,
        untrained=0,
        unseen=2,
        log_dir=config.log_dir / f"{kind}-{seed}",
        overwrite=True,
        **options,
    )
    found = Run(run, run.plant(), first=JonkmanController).train()["episodes"]
    require_finished(len(found), config.windows)
    return found


def learning_time(record: dict) -> float:
    """Wall-clock time of an episode in which the synchronous real system waits [s]."""
    return sum(seconds for step, seconds in record["seconds"].items() if step != "interact")


def course(costs: list[float], counts: list[float], waits: list[float], waiting: float, config: Config) -> float:
    """Sum of the costs over the real time, for each hour [h⁻¹].

    Args:
        costs: J_a of each episode.
        counts: number of windows of each episode.
        waits: time after each episode in which the former controller acts [s of the turbine].
        waiting: J_a of the former controller.
        config: options of the comparison.
    """
    left, total = config.hours * HOUR, 0.0
    for cost, count, wait in zip(costs, counts, waits, strict=True):
        for rate, seconds in ((cost, count * config.horizon), (waiting, wait)):
            taken = min(left, seconds)
            total, left = total + rate * taken, left - taken
    return total / config.hours


def compared(config: Config, seed: int) -> dict[str, float]:
    """Both trainings of a seed."""
    plain = trained(config, seed, "synchronous")
    waits = [config.pace * learning_time(record) for record in plain]
    former = plain[0]["start_cost"]
    share = float(np.median(waits[1:])) / config.horizon  # the first episode has the start in it
    options = {"asynchronous": True, "operation": OperationConfig(learning=share)}
    ahead = trained(config, seed, "asynchronous", **options)
    costs, counts = (
        [first, *(each[key] for each in ahead)] for key, first in (("real_cost", former), ("windows", 1.0))
    )
    ones, waits = [1.0] * (1 + len(plain)), [config.pace * plain[0]["seconds"]["start"], *waits]
    waits[1] -= waits[0]
    return {
        "seed": seed,
        "learning_share": share,
        "controller": former * HOUR,
        "synchronous": course([former, *(each["real_cost"] for each in plain)], ones, waits, former, config),
        "asynchronous": course(costs, counts, [0.0] * len(costs), former, config),
    }


def main(config: Config) -> None:
    make_folder("log_dir", config.log_dir)
    found = [compared(config, seed) for seed in config.seeds]
    path = write_results(config.log_dir / "asynchronous.json", {"config": config, "seeds": found})
    for each in found:
        ratio = each["asynchronous"] / each["synchronous"]
        print(
            f"seed {each['seed']}: cost per hour {each['synchronous']:.5g} synchronous, {each['asynchronous']:.5g} "
            f"asynchronous, ratio {ratio:.4f}; learning takes {each['learning_share']:.3f} of a window"
        )
    print(f"results in {path}")


if __name__ == "__main__":
    main_of(Config, main)
