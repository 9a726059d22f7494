"""How near a twin comes to the true system in a few real episodes without noise."""

import copy
import statistics
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import torch
from torch import nn

from rt_torchrl import AssimilationConfig, DigitalTwin, LoadedRun, Trajectory, configuration, load_run, main_of
from rt_torchrl.atomic_file import make_folder, write_results
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.runs.run_folder import load_tensors
from rt_torchrl.study.scheduling import on_this_machine
from rt_torchrl.study.training import Training
from rt_torchrl.trajectories.trajectory import batch_of

EPISODES = {"wind_turbine": 3, "flapping_wing": 2, "cryogenic_tank": 3}
"""Number of real episodes, of which the first one is flown by the classical controller."""
FITTED = ("--twinning.assimilation.inputs", "record", "--twinning.assimilation.method", "levenberg_marquardt")
"""Step 4 replays the measured inputs, of which draws would leave an error, by steps for few weights."""
OPTIONS = {
    # From the last record alone the law is right for that wind. Bent to the first one it may be in a local minimum.
    "wind_turbine": (
        *("--twinning.records", "3"),
        *("--twinning.assimilation.iterations", "100", "--twinning.assimilation.starts", "6"),
    ),
    # Without noise the fit goes on until steps end in rounding.
    "flapping_wing": ("--twinning.assimilation.iterations", "60"),
    "cryogenic_tank": (),
}
"""Options of the fit by plant."""
TO_THE_END = AssimilationConfig(iterations=300, method="levenberg_marquardt", inputs="record")
"""The fit of the best law of a form to episodes."""
GROUPS = 5
"""Number of groups of other episodes of the trained policy, each of as many as a twin has seen."""
OTHER_SEED = 3_000_000
"""Seed of these episodes."""
Misfit = Callable[[nn.Module, Trajectory], float]
"""J_p of a law on episodes."""
MEANINGS = {
    "records": "the twin on its records",
    "unseen": "the twin on unseen episodes of the policy",
    "allowed": "laws from as many other episodes of the policy, on the same",
}
"""What each comparison with the best law of the form says."""


@configuration
class Config:
    """Identify twins in a few real episodes of trainings, and compare them with the true system.

    Drone and tank have laws with true weights: the greatest relative error counts. The turbine's law cannot be the true
    table: J_p counts, over that of the best law of the same form, on the records of the twin and on unseen episodes.
    The folder keeps finished trainings, so that the same command goes on where it was interrupted.

    Args:
        plants: plants.
        seeds: number of trainings of each plant.
        unseen: number of unseen episodes of the turbine.
        jobs: number of trainings side by side.
        log_dir: folder of the trainings and of the results, accuracy.json.
    """

    plants: tuple[Literal["wind_turbine", "flapping_wing", "cryogenic_tank"], ...] = tuple(EPISODES)
    seeds: int = 5
    unseen: int = 20
    jobs: int = 1
    log_dir: Path = Path("runs/accuracy")

    def __post_init__(self):
        for argument, least in (("seeds", 1), ("unseen", 2), ("jobs", 1)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least {least}.")

    def trainings(self, plant: str) -> list[Training]:
        """A training of the model-based half for each seed."""
        return [
            Training(
                recipe=Path(__file__).with_name(f"{plant}.py"),
                arm="model_based",
                seed=seed,
                variant="nominal",
                folder=self.log_dir / plant / f"seed-{seed}",
                episodes=EPISODES[plant] - 1,
                options=("--unseen", "2", "--twinning.hypotheses.which", "none", *FITTED, *OPTIONS[plant]),
            )
            for seed in range(self.seeds)
        ]


def weight_error(training: Training) -> float:
    """Greatest relative error of the weights."""
    laws = training.metrics()["summary"]["closure"]
    return max(abs(laws["found"][name] / true - 1.0) for name, true in laws["true"].items())


class OverBest(NamedTuple):
    """J_p of laws over that of the best law of their form, minus one.

    Args:
        records: the twin's law on the records that it is fitted to, over the best law on these.
        unseen: the twin's law on unseen episodes of the trained policy, over the best law on these.
        allowed: laws on the same unseen episodes that are fitted to as many other episodes of the trained policy; the
            median. Nobody can fly these before the policy is trained.
    """

    records: float
    unseen: float
    allowed: float


def over_best(training: Training, unseen: int) -> OverBest:
    """How the law of a training's twin compares with the best ones of its form."""
    from rt_torchrl.runs.run_folder import CHECKPOINT  # here, because --help need not wait for TorchRL
    from rt_torchrl.steps.interact import ShortTermMemory

    run, count = load_run(training.folder), EPISODES[training.plant]
    memory = ShortTermMemory(count)
    memory.load_state_dict(
        load_tensors(training.folder / CHECKPOINT)["state"]["algorithm"]["module.interact._extra_state"]["short_term"]
    )
    policy, seen = run.policies["model_based"], batch_of(memory)
    episodes = UnseenEpisodes(run.plant, unseen)
    flown, misfit = episodes.fly(policy), partial(misfit_of, episodes, run)
    others = UnseenEpisodes(run.plant, GROUPS * count, seed=OTHER_SEED).fly(policy)
    best_law = partial(best_of, run, misfit)
    best = best_law(flown, [run.closure, run.initial_closure])
    best_seen = best_law(seen, [run.closure, run.initial_closure, best])
    groups = [others.each()[k * count : (k + 1) * count] for k in range(GROUPS)]
    allowed = [misfit(best_law(batch_of(group), [best]), flown) for group in groups]
    least = misfit(best, flown)
    return OverBest(
        misfit(run.closure, seen) / misfit(best_seen, seen) - 1.0,
        misfit(run.closure, flown) / least - 1.0,
        statistics.median(allowed) / least - 1.0,
    )


def best_of(run: LoadedRun, misfit: Misfit, flown: Trajectory, starts: list[nn.Module]) -> nn.Module:
    """The law with the least J_p on episodes among those that are found from several first laws."""
    from rt_torchrl.steps.assimilate import Assimilation  # here, because it loads TorchRL

    found = [copy.deepcopy(start).requires_grad_(True) for start in starts]
    for law in found:
        Assimilation(DigitalTwin(run.physics, law), TO_THE_END).update(flown.each(), [], 1, torch.Generator())
    return min(found, key=lambda law: misfit(law, flown))


def misfit_of(episodes: UnseenEpisodes, run: LoadedRun, law: nn.Module, flown: Trajectory) -> float:
    """J_p of a law, the mean over episodes as flown."""
    return episodes.identification_costs(run.physics, law, flown).mean().item()


def main(config: Config) -> None:
    torch.set_num_threads(1)
    make_folder("log_dir", config.log_dir)
    trainings = {plant: config.trainings(plant) for plant in config.plants}
    tasks = [training for each in trainings.values() for training in each]
    on_this_machine(tasks, config.jobs)
    found = {plant: [weight_error(one) for one in each] for plant, each in trainings.items() if plant != "wind_turbine"}
    laws = [over_best(one, config.unseen) for one in trainings.get("wind_turbine", [])]
    over = {name: [getattr(one, name) for one in laws] for name in OverBest._fields} if laws else {}
    write_results(config.log_dir / "accuracy.json", {"config": config, "errors": found, "over_best": over})
    print(table(found, over))
    print(f"results in {config.log_dir / 'accuracy.json'}")


def table(found: dict[str, list[float]], over: dict[str, list[float]]) -> str:
    """The errors, and J_p over the best, as Markdown."""
    lines = ["| plant | real episodes | greatest error of a weight, each seed |", "|---|---|---|"] if found else []
    lines += [f"| {plant} | {EPISODES[plant]} | {percent(errors)} |" for plant, errors in found.items()]
    if found and over:
        lines.append("")
    if over:
        lines += [f"| J_p after {EPISODES['wind_turbine']} episodes | over the best, each seed |", "|---|---|"]
        lines += [f"| {MEANINGS[name]} | {percent(excess)} |" for name, excess in over.items()]
    return "\n".join(lines)


def percent(values: list[float]) -> str:
    return ", ".join(f"{100.0 * value:.2g} %" for value in values)


if __name__ == "__main__":
    main_of(Config, main)
