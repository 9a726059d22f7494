"""What some sensors are enough for: plans on twins that were fitted to them, beside plans from the whole state."""

import statistics
from pathlib import Path
from typing import Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

from rt_torchrl import configuration, main_of
from rt_torchrl.atomic_file import make_folder, write_results
from rt_torchrl.study.scheduling import on_this_machine
from rt_torchrl.study.training import Training

FITTED = (
    *("--twinning.assimilation.method", "levenberg_marquardt", "--twinning.assimilation.inputs", "record"),
    *("--twinning.assimilation.initial", "estimated", "--twinning.assimilation.sensors"),
)
"""Options with which step 4 fits the twin to the sensors whose names follow."""
SENSORS = {
    "wind_turbine": ("rotor_speed",),
    "flapping_wing": ("forward_position", "height"),
    "cryogenic_tank": ("pressure",),
}
"""The sensors that are there, beside those of the inputs."""
SEEN = {"wind_turbine": (), "flapping_wing": ("--observe", "position+wind"), "cryogenic_tank": ()}
"""Options with which the policies observe nothing but these sensors and what a controller computes from them."""


@configuration
class Config:
    """Compare plans from some sensors with plans from the whole state, on the same unseen episodes.

    With some sensors step 4 fits the twin to what they read, and the policies observe them alone: the turbine's rotor
    speed, the drone's position, the tank's pressure. The folder keeps finished trainings, so that the same command goes
    on where it was interrupted.

    Args:
        plants: plants.
        seeds: number of trainings of each kind.
        episodes: number of real episodes, beside the first one that the classical controller flies.
        unseen: number of unseen episodes that judge the plans.
        jobs: number of trainings side by side.
        log_dir: folder of the trainings and of the results, partial.json.
    """

    plants: tuple[Literal["wind_turbine", "flapping_wing", "cryogenic_tank"], ...] = tuple(SENSORS)
    seeds: int = 3
    episodes: int = 5
    unseen: int = 100
    jobs: int = 1
    log_dir: Path = Path("runs/partial")

    def __post_init__(self):
        for argument, least in (("seeds", 1), ("episodes", 1), ("unseen", 2), ("jobs", 1)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least {least}.")

    def trainings(self, plant: str, *, partial: bool) -> list[Training]:
        """A training of the model-based half for each seed."""
        own = (*FITTED, *SENSORS[plant], *SEEN[plant]) if partial else ()
        return [
            Training(
                recipe=Path(__file__).with_name(f"{plant}.py"),
                arm="model_based",
                seed=seed,
                variant="nominal",
                folder=self.log_dir / plant / f"{'sensors' if partial else 'state'}-seed-{seed}",
                episodes=self.episodes,
                options=("--unseen", str(self.unseen), "--twinning.hypotheses.which", "none", *own),
            )
            for seed in range(self.seeds)
        ]


def costs_of(trainings: list[Training]) -> list[float]:
    """Mean J_a of the plans on the unseen episodes."""
    return [training.metrics()["summary"]["unseen"]["J_a_model_based"]["mean"] for training in trainings]


def main(config: Config) -> None:
    make_folder("log_dir", config.log_dir)
    pairs = {plant: [config.trainings(plant, partial=one) for one in (False, True)] for plant in config.plants}
    tasks = [training for pair in pairs.values() for trainings in pair for training in trainings]
    on_this_machine(tasks, config.jobs)
    found = {plant: dict(zip(("state", "sensors"), map(costs_of, pair), strict=True)) for plant, pair in pairs.items()}
    write_results(config.log_dir / "partial.json", {"config": config, "costs": found})
    print(table(found))
    print(f"results in {config.log_dir / 'partial.json'}")


def table(found: dict[str, dict[str, list[float]]]) -> str:
    """The costs, as Markdown."""
    lines = ["| plant, sensors | J_a, whole state | J_a, sensors alone | ratio of the medians |", "|---|---|---|---|"]
    for plant, costs in found.items():
        shown = (" … ".join(f"{end(each):.5g}" for end in (min, max)) for each in costs.values())
        ratio = statistics.median(costs["sensors"]) / statistics.median(costs["state"])
        lines.append(f"| {plant}, {' and '.join(SENSORS[plant])} | {' | '.join(shown)} | {ratio:.4f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main_of(Config, main)
