"""Finished runs side by side: a table with intervals, and one figure over the real episodes."""

from pathlib import Path
from typing import Annotated

import tyro

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

from rt_torchrl import configuration, main_of


@configuration
class Config:
    """Compare finished runs of one plant. Runs that differ in nothing but the seed are one row.

    Args:
        runs: run folders.
        picture: file of the figure, as PNG.
        title: title of the figure.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    picture: Path = Path("runs/comparison.png")
    title: str = "Cost of the live policy while training"

    def __post_init__(self):
        if not self.runs:
            raise ValueError("runs names no run; give the folders of finished runs.")


def main(config: Config) -> None:
    from rt_torchrl.atomic_file import make_folder
    from rt_torchrl.figures import save_figure
    from rt_torchrl.study.comparison import comparison_figure, comparison_table, entries_of

    make_folder("picture", config.picture.parent)
    runs, controllers = entries_of(config.runs)
    print(comparison_table(runs, controllers))
    save_figure(comparison_figure(runs, controllers, config.title), config.picture)
    print(f"figure in {config.picture}")


if __name__ == "__main__":
    main_of(Config, main)
