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


def costs_at_the_end(summary: Mapping[str, Any]) -> tuple[float | None, dict[str, float], str]:
    """J_a of the live policy, None if it is not finite; the finite ones of classical controllers; and where these hold.

    They are those of the flights on the real system, if the live policy has flown there, and else of unseen episodes: a
    cost on the twin is not compared with one on the real system.
    """
    judged, where = judged_at_the_end(summary)
    means = {name: entry["J_a"]["mean"] for name, entry in judged.items()}
    cost = means.pop(summary["live"])
    return cost, {name: mean for name, mean in means.items() if mean is not None}, where


def judged_at_the_end(summary: Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
    """What the live policy and classical controllers cost, by name, and where; see :func:`costs_at_the_end`."""
    unseen, live = summary["unseen"], summary["live"]
    flown = summary.get("real_unseen", {}).get("controllers", {})
    if live in flown:
        return flown, "real system"
    return unseen["baselines"] | {live: {"J_a": unseen[f"J_a_{live}"]}}, unseen["judged_on"]


def judged_on_the_system(summary: Mapping[str, Any]) -> Mapping[str, Any]:
    """``costs``, ``merit`` and ``baselines`` of a run on the system, not on the run's own twin.

    They are those of the entry ``unseen``, or of the flights on the real system.

    Raises:
        ValueError: if the run was judged on its own twin alone.
    """
    unseen = summary["unseen"]
    if not on_the_twin(unseen):
        return unseen
    real = summary.get("real_unseen", {"controllers": {}})
    if summary["live"] not in real["controllers"]:
        raise ValueError(
            "a run was judged on its own twin alone, and costs on different twins do not compare; go on with each run "
            "by --resume and --real-unseen, which flies its live policy on the real system."
        )
    baselines = {name: entry for name, entry in real["controllers"].items() if name != summary["live"]}
    merit = {name: entry["merit"] for name, entry in real["controllers"].items()}
    return {"costs": real["costs"], "merit": merit, "baselines": baselines}
