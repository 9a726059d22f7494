"""The table of counts of the campaign of faults, which stands below the tests' results."""

from collections import Counter
from pathlib import Path

COUNTS: dict[str, Counter[str]] = {}
"""For every kind of trial, the number of each outcome."""


def count(what: str, outcome: str, *, defect: bool = False) -> None:
    """Count one trial.

    Args:
        what: kind of the trial.
        outcome: what became of it, in a word.
        defect: whether that is what must not happen.
    """
    found = COUNTS.setdefault(what, Counter())
    found["tried"] += 1
    found["defects"] += defect
    found[outcome] += 1


def table() -> str:
    """The table in Markdown."""
    lines = ["| what | tried | outcomes | defects |", "|---|---|---|---|"]
    for what, found in COUNTS.items():
        rest = {key: value for key, value in found.items() if key not in ("tried", "defects")}
        said = ", ".join(f"{value} {key}" for key, value in sorted(rest.items(), key=lambda item: -item[1]))
        lines.append(f"| {what} | {found['tried']} | {said} | {found['defects']} |")
    return "\n".join(lines)


def write(path: Path) -> None:
    path.write_text(table() + "\n", encoding="utf-8")
