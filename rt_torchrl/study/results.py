"""Results of the study: costs of every arm and yardstick on the same unseen episodes, with their intervals."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rt_torchrl.study.bootstrap import mean_interval
from rt_torchrl.study.training import Training

HALVES = ("model_based", "model_free")
"""Arms that train one of the two controllers alone."""
NEAR = 1.1
"""An arm is near the oracle when it costs at most this multiple of the oracle's cost."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One row of a plant's table.

    Args:
        name: arm or yardstick.
        costs: J_a of each seed and unseen episode; a yardstick has a single row.
        merit: means of the plant's own quantities over the seeds.
        J_p_ratio: cost of the twin after training over its cost before, of each seed.
        weight_error: greatest relative error among the closure's weights, of each seed.
        curves: mean J_a of the live policy on the unseen episodes after each real episode, a list for each seed.
        twin_errors: J_p of the twin over the records it holds, after each real episode, a list for each seed.
        milliseconds: median wall-clock time of an action [ms]; None where nobody has measured it.
    """

    name: str
    costs: Float[np.ndarray, "seeds episodes"]
    merit: dict[str, float]
    J_p_ratio: list[float] = field(default_factory=list)
    weight_error: list[float] = field(default_factory=list)
    curves: list[list[float]] = field(default_factory=list)
    twin_errors: list[list[float]] = field(default_factory=list)
    milliseconds: float | None = None

    @property
    def mean(self) -> float:
        return float(self.costs.mean())

    def over(self, other: "Entry") -> float:
        """Mean over the other's mean, on the first episodes, which both have."""
        count = min(self.costs.shape[1], other.costs.shape[1])
        return float(self.costs[:, :count].mean() / other.costs[:, :count].mean())

    def interval(self) -> tuple[float, float]:
        """95 % interval of the mean over seeds and episodes."""
        return mean_interval(self.costs)

    def episodes_to(self, cost: float) -> list[int | None]:
        """Number of real episodes until the live policy costs at most ``NEAR`` times ``cost``; None for never."""
        reached = [[k + 1 for k, value in enumerate(curve) if value <= NEAR * cost] for curve in self.curves]
        return [found[0] if found else None for found in reached]


def difference(first: Entry, second: Entry) -> tuple[float, float]:
    """95 % interval of the mean of ``first`` minus the mean of ``second``.

    Costs are paired by episode, and by seed where both have the same number of seeds.

    Raises:
        ValueError: if they were not judged on the same number of episodes.
    """
    if first.costs.shape[1] != second.costs.shape[1]:
        raise ValueError(
            f"{first.name} was judged on {first.costs.shape[1]} unseen episodes, {second.name} on "
            f"{second.costs.shape[1]}; compare results of the same study."
        )
    if len(first.costs) != len(second.costs):
        return mean_interval(first.costs.mean(0, keepdims=True) - second.costs.mean(0, keepdims=True))
    return mean_interval(first.costs - second.costs)


def named(entries: list[Entry]) -> dict[str, Entry]:
    """Entries by name."""
    return {entry.name: entry for entry in entries}


def arm_entry(name: str, trainings: list[Training]) -> Entry:
    """Entry of an arm, perhaps with another policy, from its trainings: of the live policies."""
    found = [training.metrics() for training in trainings]
    summaries = [metrics["summary"] for metrics in found]
    acting = [summary["live"] for summary in summaries]
    merits = [merit_means(summary["unseen"]["merit"][live]) for summary, live in zip(summaries, acting, strict=True)]
    twinned = trainings[0].arm != "model_free"
    return Entry(
        name=name,
        costs=np.array([numbers(s["unseen"]["costs"][live]) for s, live in zip(summaries, acting, strict=True)]),
        merit={name: float(np.mean([merit[name] for merit in merits])) for name in merits[0]},
        J_p_ratio=[numeric(summary["J_p_ratio"]) for summary in summaries] if twinned else [],
        weight_error=weight_errors(summaries) if twinned else [],
        curves=[numbers(e["J_a_unseen"] for e in metrics["episodes"] if "J_a_unseen" in e) for metrics in found],
        twin_errors=[numbers(e["J_p"] for e in metrics["episodes"]) for metrics in found] if twinned else [],
    )


def numeric(found: float | None) -> float:
    """A J_p or a cost of ``metrics.json``, which holds null where the twin or an episode diverges: infinite there."""
    return math.inf if found is None else found


def numbers(found: Iterable[float | None]) -> list[float]:
    """The same of several."""
    return [numeric(one) for one in found]


def merit_means(merit: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Means of the plant's own quantities; not a number where they are not finite, as in episodes that diverge."""
    return {name: math.nan if values["mean"] is None else float(values["mean"]) for name, values in merit.items()}


def yardstick_entry(name: str, found: dict[str, Any]) -> Entry:
    """Entry of the oracle, of a classical controller, of the limit or of model predictive control."""
    median = (found.get("milliseconds") or {}).get("median")
    costs = np.array([numbers(found["costs"])])
    return Entry(name=name, costs=costs, merit=merit_means(found["merit"]), milliseconds=median)


def weight_errors(summaries: list[dict[str, Any]]) -> list[float]:
    """Greatest relative error among the closure's weights, of each training whose real closure is of the same kind."""
    return [error for summary in summaries if (error := weight_error(summary["closure"])) is not None]


def weight_error(closure: dict[str, Any]) -> float | None:
    """Greatest relative error among the weights; None where the real system's closure is of another kind.

    A real system with dynamics beside its twin may have further weights, which the closure does not know.
    """
    found, true = closure["found"], closure["true"] or {}
    if not found or not set(found) <= set(true) or not all(isinstance(value, float) for value in found.values()):
        return None
    return max(abs(found[name] / true[name] - 1.0) for name in found)


class Results(NamedTuple):
    """Everything that the study shows, by plant.

    Args:
        entries: entries of the nominal table.
        summaries: ``summary`` in ``metrics.json`` of the nominal twinning runs.
        variants: entries of each variant.
        limits: entries of the clairvoyant optimum, ``limit``, and of model predictive control, ``mpc``, on the first of
            the unseen episodes; none where they were left out.
    """

    entries: dict[str, list[Entry]]
    summaries: dict[str, list[dict[str, Any]]]
    variants: dict[str, dict[str, list[Entry]]]
    limits: dict[str, list[Entry]]
