"""What noise of the sensors and errors of the model do to every arm, in a table and in sentences."""

from rt_torchrl.study.figures import shown
from rt_torchrl.study.findings import Entry, named
from rt_torchrl.study.page import table
from rt_torchrl.study.rows import COST_HEADER, TWIN_HEADER, compared, cost_cells, merit_cells, twin_cells

HALVES = ("model_based", "model_free")
TEXT = (
    "Training with sensors that err by a share of what they read, and with what the twin does not know: a rotor that "
    "is worn from the middle of the training on, a body a third heavier than the twin believes, a heat exchanger that "
    "fouls. Policies are judged with exact sensors, on the real system as it is at the end; the classical controllers "
    "keep the gains they were tuned to before. Where there is one training of each, an interval is of that training's "
    "episodes alone."
)


def merit_table(variants: dict[str, list[Entry]], nominal: list[Entry]) -> str:
    """Every arm under every variant, with its cost over its own nominal one.

    Args:
        variants: entries of a plant by variant.
        nominal: entries of the same plant as it is.
    """
    before = {entry.name: entry.mean for entry in nominal}
    header = ["", "", *COST_HEADER, "over nominal", *nominal[0].merit, *TWIN_HEADER]
    rows = []
    for variant, entries in variants.items():
        for entry in entries:
            cells = [variant, shown(entry.name), *cost_cells(entry), f"{entry.mean / before[entry.name]:.3f}"]
            rows.append([*cells, *merit_cells(entry), *twin_cells(entry)])
    return table(header, rows)


def verdicts(variants: dict[str, list[Entry]]) -> str:
    """Whether twinning is worth more than its halves under each variant."""
    lines = []
    for variant, entries in variants.items():
        found = named(entries)
        halves = [f"against {shown(half)} alone {compared(found['twinning'], found[half])}" for half in HALVES]
        lines.append(f"- Twinning, {variant}: {'; '.join(halves)}.")
    return "\n".join(lines)
