"""How near a twin comes to the true system in a few real episodes without noise."""

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import torch

from rt_torchrl import AssimilationConfig, DigitalTwin, LoadedRun, check_options, load_run, main_of
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.runs.results_file import make_folder, write_results
from rt_torchrl.study.scheduling import on_this_machine
from rt_torchrl.study.training import Training
from rt_torchrl.twinning.assimilation import Assimilation

EPISODES = {"wind_turbine": 3, "flapping_wing": 2, "cryogenic_tank": 3}
"""Number of real episodes, of which the first one is flown by the classical controller."""
FITTED = ("--twinning.assimilation.inputs", "record", "--twinning.assimilation.method", "levenberg_marquardt")
"""Step 4 replays the measured inputs, of which draws would leave an error, by steps for few weights."""
OPTIONS = {
    # From the last record alone the law is right for that wind.
    "wind_turbine": ("--twinning.records", "3", "--twinning.assimilation.iterations", "100"),
    # By likelihood, because that begins with ten first weights: from two of five draws one descent ends with b = 0.
    "flapping_wing": (
        *("--twinning.assimilation.initial", "estimated"),
        *("--twinning.assimilation.sensors", "forward_position", "height"),
    ),
    "cryogenic_tank": (),
}
"""Options of the fit by plant."""
TO_THE_END = AssimilationConfig(iterations=300, method="levenberg_marquardt", inputs="record")
"""The fit of the best law of a form, to the very episodes that it is judged on."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Identify twins in a few real episodes of trainings, and compare them with the true system.

    Drone and tank have laws with true weights: the greatest relative error counts. The turbine's law cannot be the true
    table: J_p on unseen episodes counts, over that of the best law of the same form, which is fitted to these episodes.
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
        check_options(self)
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


def over_best(run: LoadedRun, unseen: int) -> float:
    """J_p on unseen episodes over that of the best law of the same form, minus one."""
    episodes = UnseenEpisodes(run.plant, unseen)
    flown = episodes.fly(run.policies["model_based"])
    best = copy.deepcopy(run.closure).requires_grad_(True)
    Assimilation(DigitalTwin(run.physics, best), TO_THE_END).update(flown.each(), [], 1, torch.Generator())
    J_p = [episodes.identification_costs(run.physics, law, flown).mean().item() for law in (run.closure, best)]
    return J_p[0] / J_p[1] - 1.0


def main(config: Config) -> None:
    torch.set_num_threads(1)
    make_folder("log_dir", config.log_dir)
    trainings = {plant: config.trainings(plant) for plant in config.plants}
    tasks = [training for each in trainings.values() for training in each]
    on_this_machine(tasks, config.jobs)
    found = {
        plant: [
            over_best(load_run(one.folder), config.unseen) if plant == "wind_turbine" else weight_error(one)
            for one in each
        ]
        for plant, each in trainings.items()
    }
    write_results(config.log_dir / "accuracy.json", {"config": config, "errors": found})
    print(table(found))
    print(f"results in {config.log_dir / 'accuracy.json'}")


def table(found: dict[str, list[float]]) -> str:
    """The errors, as Markdown."""
    lines = ["| plant | real episodes | greatest error of a weight, or J_p over the best, each seed |", "|---|---|---|"]
    for plant, errors in found.items():
        lines.append(f"| {plant} | {EPISODES[plant]} | {', '.join(f'{100.0 * error:.2g} %' for error in errors)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main_of(Config, main)
