"""Captions of the report's figures: they say what a figure draws, and give in numbers what a reader sees there."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from rt_torchrl.study.names import shown, title
from rt_torchrl.study.results import HALVES, NEAR, Entry, Results, named, numbers, numeric
from rt_torchrl.study.training import CHANGED

ARMS = ("twinning", *HALVES)
RUN = {
    "learning_curves": "Costs, the twin's error and the live policy; vertical lines mark swaps and clones.",
    "states": "The last real episode and the twin's replay of it.",
    "actions": "Actions of the last real episode.",
    "policy_contours": "Both policies after training.",
    "unseen": "Cost of every unseen episode under both policies and the classical controllers.",
}
"""Figures that every training draws."""
PLANT = {
    "wind_turbine": {
        "power_and_speed": "Wind, generator speed, power, torque and pitch of the last episode, with their references.",
        "power_coefficient": "Power coefficient of the twin against the true one; ticks mark visited values.",
        "scatter": "Generator speed of the twin against the real one; a perfect twin lies on the line.",
    },
    "flapping_wing": {
        "flight_path": "The last flight in the plane with its target, and the gust.",
        "flight": "Positions and speeds of real drone and twin, amplitude and stroke-plane angle.",
        "polars": "Lift and drag of the twin against the true ones.",
        "control_surfaces": "Both policies over the errors of position and speed, as the paper draws them.",
    },
    "cryogenic_tank": {
        "tank": "Pressure, masses, vent and load of the last episode.",
        "heat_exchanger": "Heat that the exchanger takes over the pressure drop at the valve, twin against true.",
        "vent_path": "Path of the vented fluid in the temperature-entropy plane.",
    },
}
"""Figures that one plant alone draws."""
CLOSURES = ("power_coefficient", "polars", "heat_exchanger")
"""Figures among these that show the twin's closure."""


def learning(results: Results) -> str:
    """Caption of the learning curves: it says when each arm comes near the oracle."""
    lines = ["Mean cost of the live policy on unseen episodes after each real episode, with the range of the seeds."]
    for plant, found in entries_by_name(results):
        arms = [f"{shown(arm)} {episodes_to(found[arm], found['oracle'])}" for arm in ARMS if arm in found]
        near = f"within {100 * (NEAR - 1):.0f} % of the oracle"
        lines.append(f"{title(plant)}, real episodes until {near}, seed by seed: {'; '.join(arms)}.")
    return " ".join(lines)


def robustness(results: Results) -> str:
    """Caption of the violins: it gives the cost of the worst unseen episode."""
    lines = ["Distribution of the cost over the unseen episodes, all seeds together."]
    for plant, found in entries_by_name(results):
        worst = [f"{shown(name)} {entry.costs.max():.3g}" for name, entry in found.items()]
        lines.append(f"{title(plant)}, the worst episode: {', '.join(worst)}.")
    return " ".join(lines)


def limits(results: Results) -> str:
    """Caption of the ratios to the limit: it gives the limit, and who comes nearest."""
    lines = ["Mean cost over that of the clairvoyant optimum, whose commands know all disturbances, on its episodes."]
    for plant, found in entries_by_name(results):
        others = named(results.limits[plant])
        best = others.pop("limit")
        ratios = {name: entry.over(best) for name, entry in (found | others).items()}
        nearest = min(ratios, key=ratios.__getitem__)
        lines.append(
            f"{title(plant)}: the limit is {best.mean:.4g}; {shown(nearest)} is nearest, {ratios[nearest]:.3f}."
        )
    return " ".join(lines)


def variants(results: Results) -> str:
    """Caption of the figure of noise and model error: it says where twinning suffers most."""
    others = any(CHANGED in harder for harder in results.variants.values())
    what = f"sensor noise{' and model error' if others else ''}"
    lines = [f"Cost of every arm under {what} over twinning's nominal cost; each point is a seed."]
    for plant, found in entries_by_name(results):
        harder = {variant: named(entries)["twinning"].mean for variant, entries in results.variants[plant].items()}
        ratios = {variant: mean / found["twinning"].mean for variant, mean in harder.items()}
        worst = max(ratios, key=ratios.__getitem__)
        lines.append(f"{title(plant)}: twinning suffers most from {worst}, {ratios[worst]:.4g} times its nominal cost.")
    return " ".join(lines)


def following(results: Results) -> str:
    """Caption of the twin's errors: it says where they end with and without model error."""
    lines = ["The twin's error after each real episode, on the system that the twin knows and with model error."]
    for plant, found in entries_by_name(results):
        arms = found["twinning"], named(results.variants[plant][CHANGED])["twinning"]
        nominal, other = (np.mean([errors[-1] for errors in arm.twin_errors]) for arm in arms)
        lines.append(f"{title(plant)}: J_p ends at {nominal:.2g}, with model error at {other:.2g}.")
    return " ".join(lines)


def gain_line(found: dict[str, Any]) -> str:
    """Caption of a cost over a gain: its first minimum, the greatest cost behind it, and the far end."""
    costs, name = found["costs"], found["name"]
    first = next((k for k, (here, after) in enumerate(zip(costs, costs[1:], strict=False)) if after > here), None)
    if first is None:
        return f"Cost over {name}; it falls all the way."
    values = [f"{name} = {value:.3g}" for value in found["values"]]
    top = first + int(np.argmax(costs[first:]))
    return (
        f"Cost of a proportional vent over its gain. It is least on the smooth side at {values[first]} with "
        f"{costs[first]:.4g}, {costs[top]:.4g} at {values[top]}, and {costs[-1]:.4g} at {values[-1]}, where the vent "
        "only opens and shuts, as the on-off valve does."
    )


def episode_line(found: dict[str, Any]) -> str:
    """Caption of a cost over the number of training episodes in a plan: it gives every cost."""
    counts, costs = found["values"], found["costs"]
    parts = ", ".join(f"{cost:.4g} on {count}" for count, cost in zip(counts, costs, strict=True))
    return (
        "Cost of the plant's own policy on the unseen episodes, over the number of training episodes in its plan. The "
        f"plan uses exact gradients on the true plant. The costs are {parts}."
    )


LINES: dict[str, Callable[[dict[str, Any]], str]] = {"gain-line": gain_line, "episode-line": episode_line}
STUDY: dict[str, Callable[[Results], str]] = {
    function.__name__: function for function in (learning, robustness, limits, variants, following)
}


def of_run(plant: str, metrics: dict[str, Any]) -> dict[str, str]:
    """Captions of a training's figures, by name.

    Args:
        plant: name of the plant's folder.
        metrics: content of ``metrics.json``.
    """
    found = RUN | PLANT[plant]
    found["learning_curves"] += " " + events(metrics)
    J_p = metrics["episodes"][-1]["J_p"]
    error = "The twin diverges on" if J_p is None else f"J_p is {J_p:.2g} over"
    found["states"] += f" {error} the records in memory."
    found["unseen"] += " " + cheaper(metrics)
    for name in CLOSURES:
        if name in found:
            found[name] += " " + closure_error(metrics)
    return found


def events(metrics: dict[str, Any]) -> str:
    """Sentences that say when policies swapped or were cloned, and what the live policy costs at the end."""
    episodes = metrics["episodes"]
    parts = []
    for event in ("swap", "clone"):
        after = [str(e["episode"] + 1) for e in episodes if e["event"] == event]
        parts.append(f"{event} after episode {', '.join(after)}" if after else f"no {event}")
    costs = [numeric(episodes[k]["J_a_unseen"]) for k in (0, -1)]
    first, last = (f"{cost:.4g}" if math.isfinite(cost) else "infinity" for cost in costs)
    return f"{'; '.join(parts).capitalize()}. J_a of the live policy went from {first} to {last}."


def cheaper(metrics: dict[str, Any]) -> str:
    """Sentence that counts the unseen episodes on which the live policy costs less than the others."""
    live = metrics["summary"]["live"]
    costs = {name: np.array(numbers(values)) for name, values in metrics["summary"]["unseen"]["costs"].items()}
    against = [f"{shown(name)} on {int((costs[live] < costs[name]).sum())}" for name in costs if name != live]
    return f"The live policy ({shown(live)}) costs less than {', '.join(against)} of {len(costs[live])}."


def closure_error(metrics: dict[str, Any]) -> str:
    """Sentence with the RMS error of the twin's closure along the last episode."""
    errors = metrics["summary"]["closure_error"]
    found, start = (", ".join(f"{error:.2g}" for error in errors[when]) for when in ("found", "start"))
    return f"The RMS error along the last episode is {found}; that of the initial twin is {start}."


def episodes_to(entry: Entry, oracle: Entry) -> str:
    """Number of real episodes until an arm comes near the oracle, seed by seed."""
    return ", ".join("never" if count is None else str(count) for count in entry.episodes_to(oracle.mean))


def entries_by_name(results: Results) -> list[tuple[str, dict[str, Entry]]]:
    """Every plant with its entries by name."""
    return [(plant, named(found)) for plant, found in results.entries.items()]
