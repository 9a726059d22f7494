"""The figures of the study: its own, and those of the first run of each plant, with captions."""

import shutil
from collections.abc import Mapping
from pathlib import Path

from rt_torchrl.study import captions
from rt_torchrl.study import figures as charts
from rt_torchrl.study.names import title
from rt_torchrl.study.report import CaptionedFigure
from rt_torchrl.study.results import Results
from rt_torchrl.study.training import CHANGED, Training
from rt_torchrl.study.yardstick import Yardstick

PLACE = Path("figures")


def draw(
    folder: Path, results: Results, lines: Mapping[str, Yardstick], runs: Mapping[str, Training]
) -> list[CaptionedFigure]:
    """Draw what there are results for into ``figures``, copy the figures of runs there, and add captions.

    Args:
        folder: folder of the report.
        results: results of the study.
        lines: costs along one quantity, of the plants that have some.
        runs: the run of each plant whose figures the report shows.
    """
    drawn = {"learning": charts.learning(results.entries), "robustness": charts.robustness(results.entries)}
    if any(results.limits.values()):
        drawn["limits"] = charts.limits(results.entries, results.limits)
    if any(results.variants.values()):
        drawn["variants"] = charts.variants(results.entries, results.variants)
    if any(CHANGED in of_plant for of_plant in results.variants.values()):
        drawn["following"] = charts.following(results.entries, results.variants)
    texts = {name: captions.STUDY[name](results) for name in drawn}
    for plant, line in lines.items():
        name, costs = f"{plant}_{line.path.stem}", line.run()
        drawn[name] = charts.cost_line(costs, results.entries[plant])
        texts[name] = captions.LINES[line.path.stem](costs)
    (folder / PLACE).mkdir(parents=True, exist_ok=True)
    found = []
    for name, figure in drawn.items():
        figure.savefig(folder / PLACE / f"{name}.png", dpi=110)
        found.append(CaptionedFigure(PLACE / f"{name}.png", texts[name]))
    return found + [figure for plant, run in runs.items() for figure in _copied(folder, plant, run)]


def _copied(folder: Path, plant: str, run: Training) -> list[CaptionedFigure]:
    found = []
    for name, text in captions.of_run(plant, run.metrics()).items():
        copy = PLACE / f"{plant}_{name}.png"
        shutil.copy(run.folder / "figures" / f"{name}.png", folder / copy)
        found.append(CaptionedFigure(copy, f"{title(plant)}, seed {run.seed}. {text}"))
    return found
