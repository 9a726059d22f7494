"""Measure the time of one gradient by each engine; the engines take turns in one process."""

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from rt_torchrl import Engine, Rollout, control_cost, main_of, shipped_plants
from rt_torchrl.trajectories.rollout import refusal

REFERENCE: Engine = "odeint_adjoint"


@dataclass(frozen=True, kw_only=True)
class Config:
    """Time the gradient of J_a with respect to policy and closure by the gradient engines.

    Args:
        plant: folder of the plant under envs.
        realisations: trajectories N_z.
        steps: number of control intervals; 0 takes the plant's whole episode.
        repeats: number of gradients of each engine; the engines take turns.
        engines: gradient engines; those that cannot roll the plant out are left out, and ratios are to the last of the
            rest.
        compiled: compile the engines.
        eager: engines that are not compiled all the same, such as odeint_adjoint as torchdiffeq ships it.
        threads: number of CPU threads; 0 keeps torch's default.
        output: JSON file for the result.
    """

    plant: str = "flapping_wing"
    realisations: int = 5
    steps: int = 0
    repeats: int = 3
    engines: tuple[Engine, ...] = ("parallel", REFERENCE)
    compiled: bool = True
    eager: tuple[Engine, ...] = ()
    threads: int = 0
    output: Path | None = None

    def __post_init__(self):
        if self.plant not in shipped_plants():
            raise ValueError(f"plant={self.plant!r} does not exist; choose one of {', '.join(shipped_plants())}.")
        if not set(self.eager) <= set(self.engines):
            raise ValueError(f"eager={self.eager} must be some of engines={self.engines}.")


def gradient(config: Config, engine: Engine) -> Callable[[], torch.Tensor]:
    """A function that computes one gradient, always of the same trajectories."""
    generator = torch.Generator().manual_seed(0)
    plant = shipped_plants()[config.plant]()
    closure, policy = plant.make_closure(generator), plant.make_policy(generator)
    initial_state = plant.draw_initial_state(config.realisations, generator)
    exogenous = plant.draw_exogenous(config.realisations, generator)[:, : config.steps or plant.n_steps]
    rollout = Rollout(plant, closure, policy, engine=engine, compiled=config.compiled and engine not in config.eager)
    weights = [w for w in (*closure.parameters(), *policy.parameters()) if w.requires_grad]

    def compute() -> torch.Tensor:
        cost = control_cost(plant, rollout(initial_state, exogenous)).mean()
        return torch.cat([part.flatten() for part in torch.autograd.grad(cost, weights)])

    return compute


def sorted_out(config: Config) -> tuple[list[Engine], dict[Engine, str]]:
    """The engines that can roll the plant out, and the reasons why the others cannot.

    Raises:
        ValueError: if no engine can.
    """
    plant = shipped_plants()[config.plant]()
    reasons = {engine: refusal(engine, plant) for engine in config.engines}
    left_out = {engine: reason for engine, reason in reasons.items() if reason}
    able = [engine for engine in reasons if engine not in left_out]
    if not able:
        raise ValueError(f"engines={config.engines}: none of them can be timed. {' '.join(left_out.values())}")
    return able, left_out


def main(config: Config) -> None:
    if config.threads:
        torch.set_num_threads(config.threads)
    able, left_out = sorted_out(config)
    for reason in left_out.values():
        print(f"left out: {reason}")
    functions = {engine: gradient(config, engine) for engine in able}
    found = {engine: compute() for engine, compute in functions.items()}  # compiles
    seconds: dict[str, list[float]] = {engine: [] for engine in functions}
    for _ in range(config.repeats):
        for engine, compute in functions.items():
            start = time.perf_counter()
            compute()
            seconds[engine].append(time.perf_counter() - start)
    last = able[-1]
    medians = {engine: statistics.median(values) for engine, values in seconds.items()}
    gaps = {engine: ((g - found[last]).norm() / found[last].norm()).item() for engine, g in found.items()}
    for engine, median in medians.items():
        print(f"{engine:<15} {median:10.3f} s   {medians[last] / median:8.1f} times faster   gap {gaps[engine]:.1e}")
    if config.output:
        result = {"seconds": seconds, "medians": medians, "gaps": gaps, "left_out": left_out}
        config.output.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main_of(Config, main)
