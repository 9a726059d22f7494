"""The file ``metrics.json`` of a run folder: how it is read, and what the policies of the run have cost where."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rt_torchrl.atomic_file import read_json
from rt_torchrl.steps.config import ROLES


def read_metrics(folder: Path) -> dict[str, Any]:
    """The results of a finished run: ``plant``, ``episodes`` and ``summary``.

    Raises:
        ValueError: if the run is not finished, or its results cannot be read or are damaged.
    """
    file = folder / "metrics.json"
    if not file.is_file():
        raise ValueError(f"the run in {folder} has no metrics.json: it is not finished; go on with it by --resume.")
    metrics = read_json(file)
    episodes, summary = metrics.get("episodes"), metrics.get("summary")
    if not (isinstance(episodes, list) and isinstance(summary, dict) and summary.get("live") in ROLES):
        raise ValueError(f"{file} is damaged: it must hold episodes, a list, and summary with the live policy.")
    return metrics


def real_costs(episodes: Sequence[Mapping[str, Any]]) -> list[float | None]:
    """J_a of each real episode; windows that were taken together have their mean. None if it is not finite."""
    return [entry["real_cost"] for entry in episodes for _ in range(int(entry.get("windows", 1)))]


def on_the_twin(unseen: Mapping[str, Any]) -> bool:
    """Whether the costs on unseen episodes are those of the twin, and not of the real system or its simulation.

    Args:
        unseen: entry ``unseen`` of the summary.
    """
    return unseen["judged_on"] == "twin"


def by_place(summary: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """What controllers cost, by the place where they flew and their names: unseen episodes, and then the real system.

    An entry has mean and interval of ``J_a`` and of each quantity in ``merit`` and, where the live policy flew the same
    episodes, the ``ratio`` of its cost to that of the controller.
    """
    unseen = summary["unseen"]
    policies = {role: {"J_a": unseen[f"J_a_{role}"], "merit": unseen["merit"][role]} for role in ROLES}
    flown = {unseen["judged_on"]: policies | unseen["baselines"]}
    return flown | ({"real system": summary["real_unseen"]["controllers"]} if "real_unseen" in summary else {})


def judged_at_the_end(summary: Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
    """What the live policy and others cost, and where: on the real system, if the live policy has flown there."""
    flown = reversed(by_place(summary).items())
    return next((controllers, place) for place, controllers in flown if summary["live"] in controllers)


def costs_at_the_end(summary: Mapping[str, Any]) -> tuple[float | None, dict[str, float], str]:
    """J_a of the live policy, None if it is not finite; the finite ones of classical controllers; and where these hold.

    A cost on the twin is not compared with one on the real system, see :func:`judged_at_the_end`.
    """
    controllers, where = judged_at_the_end(summary)
    means = {name: entry["J_a"]["mean"] for name, entry in controllers.items()}
    known = {name: mean for name, mean in means.items() if name not in ROLES and mean is not None}
    return means[summary["live"]], known, where


def judged_on_the_system(summary: Mapping[str, Any]) -> tuple[str, Mapping[str, Any], Mapping[str, Any]]:
    """The place, what controllers cost there, and each of their costs: on the system, not on the run's own twin.

    Raises:
        ValueError: if the run was judged on its own twin alone.
    """
    for place, controllers in by_place(summary).items():
        if place != "twin" and summary["live"] in controllers:
            real = place == "real system"
            costs = summary["real_unseen" if real else "unseen"]["costs"]
            return place if real else "simulation", controllers, costs
    raise ValueError(
        "a run was judged on its own twin alone, and costs on different twins do not compare; go on with each run by "
        "--resume and --real-unseen, which flies its live policy on the real system."
    )
