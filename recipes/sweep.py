"""Trainings of one plant over many seeds, and a search over options with Optuna."""

import shlex
from pathlib import Path
from typing import Annotated

import tyro

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

from rt_torchrl import configuration, main_of


@configuration
class Config:
    """Train a plant with several seeds side by side and compare them; with trials, search options for the least cost.

    Args:
        plant: name of a recipe beside this one, such as wind_turbine, or the file of a recipe.
        seeds: seeds of the trainings.
        jobs: number of processes, each with one thread; 0 for one on each core.
        given: options that every training has, in quotation marks, such as "--episodes 5 --policy bias".
        trials: number of further trials of the search; 0 for none.
        over: options to search, as option=low..high or option=one|other.
        log_dir: folder of the trainings; a sweep that was interrupted goes on there.
    """

    plant: Annotated[str, tyro.conf.Positional]
    seeds: tuple[int, ...] = (0, 1, 2)
    jobs: int = 0
    given: str = ""
    trials: int = 0
    over: tuple[str, ...] = ()
    log_dir: Path = Path("runs/sweep")

    def __post_init__(self):
        if not self.seeds or min(self.seeds) < 0:
            raise ValueError(f"seeds={self.seeds} must name seeds, which are not negative.")
        if self.jobs < 0 or self.trials < 0:
            raise ValueError(f"jobs={self.jobs} and trials={self.trials} must not be negative.")
        if bool(self.over) != bool(self.trials):
            raise ValueError(f"trials={self.trials} and over={self.over} go together: what is searched, and how often.")

    def recipe(self) -> Path:
        """The file of the recipe."""
        return Path(self.plant) if self.plant.endswith(".py") else Path(__file__).with_name(f"{self.plant}.py")


def main(config: Config) -> None:
    from rt_torchrl.figures import save_figure
    from rt_torchrl.runs.command_line import from_command_line, load_recipe
    from rt_torchrl.study.comparison import comparison_figure, comparison_table, entries_of
    from rt_torchrl.study.sweep import Searched, search, seeded_runs, train_all, trials_table

    recipe, options = config.recipe(), shlex.split(config.given)
    over = [Searched.read(text) for text in config.over]
    from_command_line(load_recipe(recipe).Config, options)  # a mistake ends it here and not in every training
    folder = config.log_dir / recipe.stem
    if over:
        jobs = {"trials": config.trials, "jobs": config.jobs}
        print(trials_table(search(recipe, over, config.seeds, folder, options=options, **jobs)))
        return
    runs = seeded_runs(recipe, config.seeds, folder, options)
    train_all(runs, config.jobs)
    rows = entries_of([run.folder for run in runs])
    print(comparison_table(*rows))
    save_figure(comparison_figure(*rows, "Cost of the live policy while training"), folder / "seeds.png")
    print(f"figure in {folder / 'seeds.png'}")


if __name__ == "__main__":
    main_of(Config, main)
