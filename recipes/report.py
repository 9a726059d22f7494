"""The page of a finished run: one HTML file with the story of the training, to look at and to send to a colleague."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

from rt_torchrl import check_options, load_run, main_of


@dataclass(frozen=True, kw_only=True)
class Config:
    """Write report.html into the folder of a finished run; it needs no server and no network.

    Args:
        run: run folder of any recipe.
        recipe: file of the recipe, or package.module:Config, if the run does not name it or it has moved.
    """

    run: Annotated[Path, tyro.conf.Positional]
    recipe: str | None = None

    def __post_init__(self):
        check_options(self)


def main(config: Config) -> None:
    from rt_torchrl import write_report  # here, because --help need not wait for Matplotlib

    print(f"report in {write_report(load_run(config.run, config.recipe))}")


if __name__ == "__main__":
    main_of(Config, main)
