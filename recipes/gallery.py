"""Draw the pictures of the documentation's gallery: train each plant, and copy its figures under their names."""

import shutil
from pathlib import Path

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

from rt_torchrl import configuration, main_of

PICTURES = {
    "wind_turbine": (
        *("flights.png", "states.png", "actions.png", "power_and_speed.png", "power_coefficient.png", "scatter.png"),
        *("exogenous.png", "policy_contours.png", "closure_weights.png", "learning_curves.png", "seconds.png"),
        *("unseen.png", "animation.gif"),
    ),
    "flapping_wing": ("flight_path.png", "flight.png", "polars.png", "control_surfaces.png", "animation.gif"),
    "cryogenic_tank": ("tank.png", "vent_path.png", "animation.gif"),
}
"""Files of each plant that the gallery shows, by the name of its recipe."""


@configuration
class Config:
    """Draw every picture of docs/gallery.md.

    Args:
        plants: plants whose pictures are drawn.
        quick: whether to train for three episodes instead of twenty.
        output: folder of the pictures, docs/gallery for the documentation itself.
        log_dir: folder of the trainings; a plant whose training has ended there is not trained again.
    """

    plants: tuple[str, ...] = tuple(PICTURES)
    quick: bool = False
    output: Path = Path("runs/gallery/pictures")
    log_dir: Path = Path("runs/gallery")

    def __post_init__(self):
        unknown = sorted(set(self.plants) - set(PICTURES))
        if unknown or not self.plants:
            raise ValueError(f"plants={self.plants} must be some of {', '.join(PICTURES)}.")


def main(config: Config) -> None:
    config.output.mkdir(parents=True, exist_ok=True)
    for plant in config.plants:
        figures = trained(plant, config) / "figures"
        for name in PICTURES[plant]:
            shutil.copyfile(figures / name, config.output / f"{plant}_{name}")
        print(f"{len(PICTURES[plant])} pictures of {plant} in {config.output}")


def trained(plant: str, config: Config) -> Path:
    """The folder of a training of this plant, which is made unless it has ended."""
    from rt_torchrl.runs.command_line import from_command_line, load_recipe

    folder = config.log_dir / plant
    if not all((folder / "figures" / name).exists() for name in ("unseen.png", *PICTURES[plant])):
        recipe = load_recipe(Path(__file__).with_name(f"{plant}.py"))
        options = ["--threads", "1", "--log-dir", str(folder), "--overwrite", *(["--quick"] if config.quick else [])]
        recipe.main(from_command_line(recipe.Config, options))
    return folder


if __name__ == "__main__":
    main_of(Config, main)
