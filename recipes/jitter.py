"""How well the control period is kept with and without learning beside it, measured in turn."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import numpy as np
import torch

from rt_torchrl import OperationConfig, check_options, main_of
from rt_torchrl.runs.results_file import make_folder, write_results

NAME = "model_free"


@dataclass(frozen=True, kw_only=True)
class Config:
    """Measure the jitter of the control period, in turn with and without learning beside it.

    A wind turbine in simulation is controlled in a process of its own. In half of the turns this process learns, with
    steps 2 to 6 over and over; in the others it waits. The learner is timed once more without any control beside it.

    Args:
        seconds: length of a turn [s].
        turns: number of turns of each kind.
        period: control period [s].
        core: number of the CPU core of the acting process; -1 for the last one, -2 for any.
        realtime: whether the acting process runs before all others, which needs root or CAP_SYS_NICE.
        threads: number of threads of the learner.
        seed: seed of the turbine, its policies and its wind.
        log_dir: folder of the results, jitter.json.
    """

    seconds: float = 60.0
    turns: int = 5
    period: float = 0.02
    core: int = -1
    realtime: bool = False
    threads: int = 1
    seed: int = 0
    log_dir: Path = Path("runs/jitter")

    def __post_init__(self):
        check_options(self)
        for argument in ("seconds", "turns", "period", "threads"):
            if not getattr(self, argument) > 0:
                raise ValueError(f"{argument}={getattr(self, argument)} must be positive.")


class Learner:
    """Steps 2 to 6 of a training whose real episode is over, over and over.

    Args:
        config: options of the measurement.
    """

    def __init__(self, config: Config):
        from rt_torchrl import DigitalTwin, PlantEnv, ReinforcementTwinning
        from rt_torchrl.envs.wind_turbine.plant import WindTurbine

        generator = torch.Generator().manual_seed(config.seed)
        # A window lasts a second, so that a turn has many of them, as the operation of a fast machine has.
        self.plant = WindTurbine(horizon=25.0)
        self.policies = {role: self.plant.make_policy(generator) for role in ("model_free", "model_based")}
        twin = DigitalTwin(self.plant, self.plant.make_closure(generator))
        env = PlantEnv(self.plant, seed=config.seed)
        from wind_turbine import DEFAULT

        self.algorithm = ReinforcementTwinning(env, twin, **self.policies, config=DEFAULT, generator=generator)
        from tensordict import TensorDict  # here, because it takes seconds to load, and a command line needs none

        self.episode = self.algorithm(TensorDict({"number": 0}))

    def learn(self) -> float:
        """Learn once; the time that it took [s]."""
        begun = time.perf_counter()
        for name, step in self.algorithm.module.items():
            if name != "interact":
                step(self.episode)
        return time.perf_counter() - begun


def turn(operation, learner: Learner | None, seconds: float) -> tuple[np.ndarray, list[float]]:
    """One turn: the lateness of the intervals that end in it [s], and the times of the learner's rounds [s]."""
    end, late, rounds = time.monotonic() + seconds, [], []
    while operation.waiting():
        operation.rollout()  # windows that began before the turn
    operation.rollout()
    while time.monotonic() < end:
        if learner is not None:
            rounds.append(learner.learn())
            operation.hand_over(NAME, learner.policies[NAME], strength=0.0)
            while operation.waiting():
                late.append(operation.rollout()["late"].flatten().numpy())
        else:
            late.append(operation.rollout()["late"].flatten().numpy())
    return np.concatenate(late) if late else np.zeros(0), rounds


def statistics(late: list[np.ndarray], period: float) -> dict[str, float]:
    """What the lateness of many intervals says; an interval is missed if it begins a whole period late."""
    all_late = 1e3 * np.concatenate(late)
    median, p99 = np.percentile(all_late, [50.0, 99.0]).tolist()
    missed = float((all_late >= 1e3 * period).sum())
    return {
        "intervals": float(len(all_late)),
        "median_ms": median,
        "p99_ms": p99,
        "max_ms": float(all_late.max()),
        "missed": missed,
    }


def measure(operation, learner: Learner, config: Config) -> tuple[dict[str, dict[str, float]], list[float]]:
    """Lateness without and with learning beside it, in turn, and the times of the learner's rounds [s]."""
    late, rounds = {"idle": [], "learning": []}, []
    operation.hand_over(NAME, learner.policies[NAME], strength=0.0)
    for k in range(config.turns):
        for kind, beside in (("idle", None), ("learning", learner)):
            found, times = turn(operation, beside, config.seconds)
            late[kind].append(found)
            rounds += times
        print(f"turns {k + 1} of {config.turns} done", file=sys.stderr)
    return {kind: statistics(found, config.period) for kind, found in late.items()}, rounds


def main(config: Config) -> None:
    # Here, because --help need not wait for TorchRL.
    from functools import partial

    from rt_torchrl import ExplorationConfig, PlantEnv
    from rt_torchrl.systems.operation.acting import Crew
    from rt_torchrl.systems.operation.process import ProcessOperation

    torch.set_num_threads(config.threads)
    make_folder("log_dir", config.log_dir)
    learner = Learner(config)
    alone = [learner.learn() for _ in range(3)]
    plant = learner.plant
    scheduled = {"core": config.core, "realtime": config.realtime}
    options = OperationConfig(clock="wall", speed=plant.dt / config.period, continuous=True, **scheduled)
    make_env = partial(PlantEnv, plant, seed=config.seed + 1)
    crew = Crew(make_env, plant, {NAME: learner.policies[NAME]}, ExplorationConfig(episodes=0), options, seed=0)
    operation = ProcessOperation(crew, make_env())
    try:
        found, rounds = measure(operation, learner, config)
    finally:
        operation.close()
    alone += [learner.learn() for _ in range(3)]
    seconds = {"alone": float(np.median(alone)), "beside": float(np.median(rounds))}
    ratio = seconds["beside"] / seconds["alone"]
    times = {"learner_seconds": seconds, "learner_ratio": ratio}
    path = write_results(config.log_dir / "jitter.json", {"config": config, **found, **times})
    for kind, numbers in found.items():
        told = ", ".join(f"{name.replace('_', ' ')} {value:.6g}" for name, value in numbers.items())
        print(f"{kind}: {told}")
    print(f"learner: {ratio:.3g} times as long beside the control as alone")
    print(f"results in {path}")


if __name__ == "__main__":
    main_of(Config, main)
