"""The page of findings about arms on systems: tables, counts of alarms, what each part was worth, as Markdown."""

from collections.abc import Mapping, Sequence

import numpy as np

from rt_torchrl.study.arms import (
    NO_WORTH,
    AlarmCount,
    Arm,
    SystemResult,
    false_alarms,
    missed_alarms,
    missed_errors,
)
from rt_torchrl.study.results import difference

COST = ["J_a, median", "range", "95 % interval of the mean", "over oracle"]
HEADER = ["arm", "seeds", *COST, "Σ paid", "regret", "alarms"]
WHOLE = "twinning"
"""Arm with all parts, of which the ablation takes one after another."""
COUNTED = {
    "false": "false, of the episodes as the twin",
    "missed": "missed, of the episodes with a gap of 10 %",
    "missed, twin wrong": "missed where the twin is a tenth off about the policy, too",
}
"""Headings of what is counted."""
TARGET = 0.05
"""Greatest share of false alarms, and of missed ones."""


def system_section(found: SystemResult) -> str:
    """The table of one system, and what its numbers say."""
    from rt_torchrl.study.tables import table  # here, because the help of a recipe need not wait for Matplotlib

    rows = [cells(arm, found) for arm in found.arms]
    low, high = found.oracle.interval()
    oracle = ["oracle", "", f"{found.oracle.mean:.4g}", "", f"{low:.4g} … {high:.4g}"]
    rows.append([*oracle, f"{found.oracle.mean / found.least:.3f}", "", "", ""])
    return "\n\n".join([f"### {found.title}", table(HEADER, rows), sentences(found)])


def cells(arm: Arm, found: SystemResult) -> list[str]:
    """A row of the table."""
    means = arm.entry.costs.mean(1)
    low, high = arm.entry.interval()
    few = arm.entry.costs.shape[1] < found.oracle.costs.shape[1]
    over = arm.entry.over(found.oracle) * (1.0 if few else found.oracle.mean / found.least)
    cost = [f"{arm.median():.4g}", f"{means.min():.4g} … {means.max():.4g}", f"{low:.4g} … {high:.4g}", f"{over:.3f}"]
    if not arm.paid:
        return [arm.name, "", cost[0], "", *cost[2:], "", "", ""]
    alarms = str(sum(map(sum, arm.alarms))) if arm.alarms else "–"
    regret = float(np.median(arm.regret(found.least)[:, -1]))
    return [arm.name, str(len(means)), *cost, f"{np.median(arm.sums()):.4g}", f"{regret:.4g}", alarms]


def sentences(found: SystemResult) -> str:
    """Which arm ends cheapest and which has paid least, and how the whole compares with the other arms."""
    trained = [arm for arm in found.arms if arm.paid]
    cheapest, thrifty = min(trained, key=Arm.median), min(trained, key=lambda arm: float(np.median(arm.sums())))
    lines = [
        f"- {cheapest.name} ends at the least cost, {cheapest.median():.4g}; {thrifty.name} has paid least on the way, "
        f"{np.median(thrifty.sums()):.4g}."
    ]
    whole = found.arm(WHOLE)
    if whole is None:
        return lines[0]
    same = [arm for arm in found.arms if arm is not whole and arm.entry.costs.shape[1] == whole.entry.costs.shape[1]]
    verdicts: dict[str, list[str]] = {"better than": [], "worse than": [], "neither better nor worse than": []}
    for arm in same:
        low, high = difference(whole.entry, arm.entry)
        word = "better than" if high < 0 else "worse than" if low > 0 else "neither better nor worse than"
        verdicts[word].append(arm.name)
    said = [f"{word} {', '.join(names)}" for word, names in verdicts.items() if names]
    return "\n".join([*lines, f"- {WHOLE} is, with 95 % confidence, {'; '.join(said)}."] if said else lines)


def ablation_section(results: Sequence[SystemResult], parts: Mapping[str, str]) -> str:
    """What each part was worth: cost and sum of costs without it, as shares of those with it.

    Args:
        results: the systems.
        parts: name of each part, by the arm that lacks it.
    """
    from rt_torchrl.study.tables import table  # here, because the help of a recipe need not wait for Matplotlib

    known = [found for found in results if found.arm(WHOLE)]
    rows, said = [], []
    for name, part in parts.items():
        pairs = [(found, found.arm(name)) for found in known]
        shares = [without(found.arm(WHOLE), arm) for found, arm in pairs if arm is not None]
        if not shares:
            continue
        places = [found.title for found, arm in pairs if arm is not None]
        rows += [
            [part, place, f"{cost:.3f}", f"{paid:.3f}"] for place, (cost, paid) in zip(places, shares, strict=True)
        ]
        said.append(f"- {part}: {verdict(shares)}.")
    if not rows:
        return ""
    header = ["without", "system", "J_a over that of the whole", "Σ over that of the whole"]
    return "\n\n".join(["## What each part was worth", table(header, rows), "\n".join(said)])


def without(whole: Arm | None, arm: Arm) -> tuple[float, float]:
    """Median cost and median sum of an arm as shares of those of the whole."""
    assert whole is not None
    return arm.median() / whole.median(), float(np.median(arm.sums()) / np.median(whole.sums()))


def verdict(shares: Sequence[tuple[float, float]]) -> str:
    """In how many rows a part was worth something: its absence makes the cost, or the sum, greater than scatter."""
    helps = sum(max(cost, paid) > 1.0 + NO_WORTH for cost, paid in shares)
    harms = sum(min(cost, paid) < 1.0 - NO_WORTH for cost, paid in shares)
    if not helps and not harms:
        return f"worth nothing in any of {len(shares)} rows"
    return (
        f"in {helps} of {len(shares)} rows the end or the way costs more than {100 * NO_WORTH:.0f} % more without it, "
        f"in {harms} less"
    )


def counted(arm: Arm, found: SystemResult) -> dict[str, AlarmCount]:
    """What is wrong with the alarms of an arm on a system."""
    if not found.system:
        return {"false": false_alarms(arm)}
    return {"missed": missed_alarms(arm, found.least), "missed, twin wrong": missed_errors(arm, found.least)}


def alarm_section(results: Sequence[SystemResult]) -> str:
    """False and missed alarms of every arm that has a twin, over all systems."""
    from rt_torchrl.study.tables import table  # here, because the help of a recipe need not wait for Matplotlib

    counts: dict[str, dict[str, AlarmCount]] = {}
    for found in results:
        for arm in found.arms:
            if arm.alarms:
                count = counts.setdefault(arm.name, dict.fromkeys(COUNTED, AlarmCount(0, 0)))
                for kind, one in counted(arm, found).items():
                    count[kind] += one
    if not counts:
        return ""
    rows = [[name, *(count[kind].words() for kind in COUNTED)] for name, count in counts.items()]
    total = {kind: sum((count[kind] for count in counts.values()), AlarmCount(0, 0)) for kind in COUNTED}
    said = [
        f"- {kind}: {count.words()}; at most {100 * TARGET:.0f} % are wanted: "
        f"{'yes' if count.wrong <= TARGET * count.episodes else 'no'}."
        for kind, count in total.items()
        if count.episodes
    ]
    header = ["arm", *COUNTED.values()]
    return "\n\n".join(["## Alarms", table(header, rows), "\n".join(said)])


def findings_page(results: Sequence[SystemResult], parts: Mapping[str, str], command: str) -> str:
    """The whole page."""
    cases = dict.fromkeys(found.case for found in results)
    blocks = [f"`{command}`", ablation_section(results, parts), alarm_section(results)]
    for case in cases:
        blocks.append(f"## {case}")
        blocks += [system_section(found) for found in results if found.case == case]
    return "\n\n".join(block for block in blocks if block)
