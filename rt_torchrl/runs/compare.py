"""Finished runs beside each other: what they cost over several seeds, as a table, as numbers and as a figure."""

import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rt_torchrl.runs.metrics import judged_on_the_system, read_metrics, real_costs
from rt_torchrl.runs.settings import BESIDE, BESIDE_TRAINING, flat, read_settings, task_of
from rt_torchrl.steps.config import ROLES, Role

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NEAR = 0.1
"""Distance from the optimum, as a share of it, within which a policy is near the optimum."""
EXCLUDED = {*BESIDE, *BESIDE_TRAINING, "seed"}
"""Settings in which the runs of one row may differ."""
COLOURS = ("#222222", "#0072B2", "#E69F00", "#CC79A7", "#56B4E9", "#7f3c8d", "#a0522d", "#6b8e23")
DASHES = ("--", ":", "-.", (0, (1, 1)))


@dataclass(frozen=True, kw_only=True)
class FinishedRun:
    """What a finished run cost; numbers that the run holds as null, because something diverged, are infinite.

    Args:
        folder: run folder.
        settings: content of ``config.json``.
        place: system that the costs on unseen episodes are those of: the simulated or the real one.
        live: role of the policy that was live at the end.
        costs: J_a of that policy on each unseen episode.
        unseen: mean J_a of the live policy on the unseen episodes after each real episode (``--unseen-every 1``); None
            without.
        real: J_a of each real episode.
        merit: mean of each of the plant's own quantities under that policy.
        controllers: mean J_a of each classical controller over the unseen episodes, and means of the plant's own
            quantities.
        alarms: number of episodes with an alarm.
        seconds: time of the six steps in all episodes [s].
    """

    folder: Path
    settings: dict[str, Any]
    place: str
    live: Role
    costs: list[float]
    unseen: list[float] | None
    real: list[float]
    merit: dict[str, float]
    controllers: dict[str, tuple[float, dict[str, float]]]
    alarms: int
    seconds: float

    @property
    def seed(self) -> int:
        return int(self.settings["seed"])

    @property
    def cost(self) -> float:
        """J_a of the policy that was live at the end, mean over the unseen episodes."""
        return statistics.fmean(self.costs)

    @classmethod
    def read(cls, folder: Path) -> "FinishedRun":
        """The run in a folder.

        Raises:
            ValueError: if the folder holds no finished run, its results are damaged, or it was judged on its own twin
                alone.
        """
        metrics = read_metrics(folder)
        summary, episodes = metrics["summary"], metrics["episodes"]
        (place, controllers, costs), live = judged_on_the_system(summary), summary["live"]
        judged = all("J_a_unseen" in episode for episode in episodes)
        return cls(
            folder=folder,
            settings=read_settings(folder),
            place=place,
            live=live,
            costs=_numbers(costs[live]),
            unseen=_numbers(episode["J_a_unseen"] for episode in episodes) if judged else None,
            real=_numbers(real_costs(episodes)),
            merit=_means(controllers[live]["merit"]),
            controllers={
                name: (statistics.fmean(_numbers(costs[name])), _means(entry["merit"]))
                for name, entry in controllers.items()
                if name not in ROLES
            },
            alarms=sum(episode.get("alarm", 0.0) > 0.0 for episode in episodes),
            seconds=sum(sum(episode.get("seconds", {}).values()) for episode in episodes),
        )


@dataclass(frozen=True, kw_only=True)
class Row:
    """Runs that differ in nothing but the seed.

    Args:
        name: name of the row.
        runs: the runs.
        optimum: least cost that a policy of this class can have on the unseen episodes; None if nobody knows it.
    """

    name: str
    runs: Sequence[FinishedRun]
    optimum: float | None = None

    @property
    def costs(self) -> dict[int, float]:
        """J_a on the unseen episodes at the end, by seed."""
        return {run.seed: run.cost for run in self.runs}

    @property
    def paid(self) -> dict[int, float]:
        """Sum of J_a of the real episodes, by seed."""
        return {run.seed: sum(run.real) for run in self.runs}

    @property
    def episodes_to_optimum(self) -> list[float] | None:
        """Number of real episodes until the live policy of each run is near the optimum; infinite for never."""
        courses = [run.unseen for run in self.runs if run.unseen is not None]
        if self.optimum is None or len(courses) < len(self.runs):
            return None
        near = self.optimum + NEAR * abs(self.optimum)
        reached = [[k for k, cost in enumerate(course, 1) if cost <= near] for course in courses]
        return [float(numbers[0]) if numbers else math.inf for numbers in reached]

    def numbers(self, first: "Row") -> dict[str, Any]:
        """All statistics: median and range over the seeds, and ratios to another row, as :func:`paired_ratio` has them.

        Args:
            first: row that this one is compared with.
        """
        return {
            "seeds": sorted(self.costs),
            "J_a": spread(list(self.costs.values())),
            "J_a_ratio": paired_ratio(self.costs, first.costs),
            "optimum": self.optimum,
            "paid": spread(list(self.paid.values())),
            "paid_ratio": paired_ratio(self.paid, first.paid),
            "episodes_to_optimum": spread(self.episodes_to_optimum),
            "alarms": spread([float(run.alarms) for run in self.runs]),
            "seconds": spread([run.seconds for run in self.runs]),
            "merit": {name: float(np.median([run.merit[name] for run in self.runs])) for name in self.runs[0].merit},
            "unseen": [run.unseen for run in self.runs],
            "real": [run.real for run in self.runs],
        }


class Comparison:
    """Rows of one plant; the first one is what the others are compared with.

    Args:
        title: name of the system.
        rows: rows, whose runs were judged on the same task and the same number of unseen episodes at one place.

    Raises:
        ValueError: if they were not, or a seed occurs twice in a row.
    """

    def __init__(self, title: str, rows: Sequence[Row]):
        runs = [run for row in rows for run in row.runs]
        for name, values in (
            ("plant", [str(run.settings["plant"]) for run in runs]),
            ("number of unseen episodes", [str(len(run.costs)) for run in runs]),
            ("place of the unseen episodes", [run.place for run in runs]),
            ("task", [json.dumps(task_of(run.settings), sort_keys=True) for run in runs]),
        ):
            if len(set(values)) > 1:
                raise ValueError(f"the runs differ in their {name} ({', '.join(values)}); compare runs of one.")
        for row in rows:
            if len(row.costs) < len(row.runs):
                folders = ", ".join(str(run.folder) for run in row.runs)
                raise ValueError(f"some of {folders} have the same seed and the same options; give one of them.")
        self.title, self.rows = title, rows

    def numbers(self) -> dict[str, Any]:
        """All statistics by row, and J_a of the classical controllers by name."""
        return {
            "rows": {row.name: row.numbers(self.rows[0]) for row in self.rows},
            "controllers": {name: cost for name, (cost, _) in self.rows[0].runs[0].controllers.items()},
        }

    def table(self) -> str:
        """The statistics and, below them, the plant's own quantities, as two Markdown tables."""
        first, controllers = self.rows[0].name, self.rows[0].runs[0].controllers
        lines, merits = list[tuple[str, dict[str, str]]](), list[tuple[str, dict[str, float]]]()
        for name, row in self.numbers()["rows"].items():
            cells = {
                "seeds": str(len(row["seeds"])),
                "J_a": with_range(row["J_a"]),
                "over the optimum": above(row["J_a"]["median"], row["optimum"]),
                f"J_a over {first}": with_interval(row["J_a_ratio"]),
                "Σ J_a": with_range(row["paid"]),
                f"Σ over {first}": with_interval(row["paid_ratio"]),
                "episodes to 110 %": with_range(row["episodes_to_optimum"]).replace("inf", "never"),
                "alarms": with_range(row["alarms"]),
                "seconds": with_range(row["seconds"]),
            }
            lines.append((name, cells))
            merits.append((name, row["merit"]))
        optima = [(f"optimum ({row.name})", row.optimum) for row in self.rows if row.optimum is not None]
        known = [(name, cost) for name, (cost, _) in controllers.items()] + optima
        lines += [(name, {"J_a": f"{cost:.4g}"}) for name, cost in known]
        merits += [(name, merit) for name, (_, merit) in controllers.items()]
        # Runs with limits of states have quantities that others have not.
        quantities = [(name, {quantity: f"{x:.4g}" for quantity, x in merit.items()}) for name, merit in merits]
        return "\n\n".join(
            [markdown(lines), *([markdown(quantities)] if any(cells for _, cells in quantities) else [])]
        )


def compare_runs(folders: Iterable[Path | str]) -> Comparison:
    """Finished runs of one plant beside each other: those that differ in nothing but the seed are one row.

    Args:
        folders: run folders; the first one belongs to the row that the others are compared with.

    Raises:
        ValueError: if a folder holds no finished run, a seed occurs twice in a row, or the runs cannot be compared.
    """
    runs = [FinishedRun.read(Path(folder)) for folder in folders]
    if not runs:
        raise ValueError("folders names no run; give the folders of finished runs.")
    options = [flat({key: value for key, value in run.settings.items() if key not in EXCLUDED}) for run in runs]
    keys = dict.fromkeys(key for settings in options for key in settings)
    differing = [key for key in keys if len({json.dumps(settings.get(key)) for settings in options}) > 1]
    rows: dict[str, list[FinishedRun]] = {}
    for run, settings in zip(runs, options, strict=True):
        labels = [f"{key.removeprefix('twinning.')} {_words(settings.get(key))}" for key in differing]
        rows.setdefault(", ".join(labels) or "all", []).append(run)
    title = str(runs[0].settings["plant"]).replace("_", " ")
    return Comparison(title, [Row(name=name, runs=row) for name, row in rows.items()])


def spread(values: Sequence[float] | None) -> dict[str, float] | None:
    """Median, least and greatest of some values; None of None."""
    if values is None:
        return None
    return {"median": statistics.median(values), "least": min(values), "greatest": max(values)}


def paired_ratio(costs: dict[int, float], others: dict[int, float]) -> dict[str, float | None] | None:
    """Geometric mean of the ratios of costs that belong to the same seed, with its 95 % interval.

    The interval is that of Student's t for the mean of the logarithms; a single pair has none.

    Args:
        costs: costs by seed.
        others: costs that they are divided by, by seed.

    Returns:
        ``ratio``, ``low`` and ``high``; None without common seeds, or where a cost is not positive or not finite.
    """
    from scipy.stats import t  # here, because it takes a second to load

    pairs = [(costs[seed], others[seed]) for seed in costs if seed in others]
    if not pairs or not all(0.0 < cost < math.inf for pair in pairs for cost in pair):
        return None
    logs = np.array([math.log(cost / other) for cost, other in pairs])
    n, mean = len(logs), float(logs.mean())
    if n == 1:
        return {"ratio": math.exp(mean), "low": None, "high": None}
    half = float(t.ppf(0.975, n - 1) * logs.std(ddof=1)) / math.sqrt(n)
    return {"ratio": math.exp(mean), "low": math.exp(mean - half), "high": math.exp(mean + half)}


def above(cost: float, optimum: float | None) -> str:
    """How far a cost is above the optimum, as a share of its size, for a table; empty where it has none."""
    if not optimum or not math.isfinite(optimum):
        return ""
    return f"{100.0 * (cost - optimum) / abs(optimum):+.3g} %"


def with_range(values: dict[str, float] | None) -> str:
    """A median with its range, for a table."""
    if values is None:
        return ""
    median, low, high = (f"{value:.4g}" for value in values.values())
    return median if low == high else f"{median} ({low} … {high})"


def with_interval(ratio: dict[str, float | None] | None) -> str:
    """A ratio with its interval, for a table."""
    if ratio is None:
        return ""
    texts = [f"{value:.3f}" if value < 10.0 else f"{value:.3g}" for value in ratio.values() if value is not None]
    if ratio["low"] in (None, ratio["high"]):  # of one seed, or of a row over itself
        return texts[0]
    return f"{texts[0]} [{texts[1]}, {texts[2]}]"


def markdown(rows: Sequence[tuple[str, Mapping[str, str]]]) -> str:
    """A Markdown table of rows with a name and cells by column; a column whose cells are all empty is left out."""
    columns = dict.fromkeys(column for _, cells in rows for column in cells)
    shown = [column for column in columns if any(cells.get(column) for _, cells in rows)]
    lines = [[name, *(cells.get(column, "") for column in shown)] for name, cells in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in (["", *shown], ["---"] * (len(shown) + 1), *lines))


def comparison_figure(comparisons: Sequence[Comparison], title: str) -> "Figure":
    """J_a of the live policies over the real episodes: a panel for each system.

    A line is the median of a row's seeds, its band their range. The optimum and classical controllers are horizontal.
    Costs are those on unseen episodes where all runs of a system have them, or else those of the real episodes.
    """
    from matplotlib.ticker import MaxNLocator  # here, because tables need no figure

    from rt_torchrl.figures.style import grid, legend_below

    names = list(dict.fromkeys(row.name for comparison in comparisons for row in comparison.rows))
    columns = 2 if len(comparisons) == 4 else min(3, len(comparisons))
    size = (max(6.5, 4.6 * columns), 0.9 + 3.3 * -(-len(comparisons) // columns))
    figure, axes = grid(len(comparisons), columns, title=title, size=size, xlabel="real episodes")
    for ax, comparison in zip(axes, comparisons, strict=True):
        _panel(ax, comparison, names)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    legend_below(figure, axes)
    return figure


def _panel(ax: "Axes", comparison: Comparison, names: Sequence[str]) -> None:
    """The rows of one system."""
    from rt_torchrl.figures.style import REFERENCE_LINE, caption, logarithmic_if_wide

    judged = all(run.unseen is not None for row in comparison.rows for run in row.runs)
    for row in comparison.rows:
        courses = [run.real if run.unseen is None or not judged else run.unseen for run in row.runs]
        length, place = min(map(len, courses)), names.index(row.name)
        curves, number = np.array([course[:length] for course in courses]), np.arange(1, length + 1)
        look: dict[str, Any] = {"color": COLOURS[place % len(COLOURS)]}
        ax.fill_between(number, curves.min(0), curves.max(0), alpha=0.12, linewidth=0, **look)
        ax.plot(number, np.median(curves, 0), "o-", markersize=4, label=row.name, **look)
    for optimum in {row.optimum for row in comparison.rows if row.optimum is not None}:
        ax.axhline(optimum, color="black", linewidth=1.0, label="optimum")
    controllers = comparison.rows[0].runs[0].controllers
    for (name, (cost, _)), dash in zip(controllers.items(), DASHES * len(controllers), strict=False):
        ax.axhline(cost, label=name, **REFERENCE_LINE | {"linestyle": dash})
    caption(ax, f"{comparison.title}: $J_a$" + ("" if judged else " of the real episodes"))
    logarithmic_if_wide(ax)


def _numbers(values: Iterable[float | None]) -> list[float]:
    return [math.inf if value is None else float(value) for value in values]


def _means(merit: dict[str, dict[str, Any]]) -> dict[str, float]:
    return {name: math.nan if quantity["mean"] is None else float(quantity["mean"]) for name, quantity in merit.items()}


def _words(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
