"""How much a policy could cost less than one that is planned on a twin which does not know the real system."""

import os
import re
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rt_torchrl.atomic_file import write_atomically

LEAST = 0.03
"""Gap below which a system is no evidence for or against a method."""
HEADER = ["system", "oracle", "planned, median (range)", "gap", "twin says", "classical", "room"]
HELPED = ["with hypotheses, median (range)", "gap", "paid, median: alone, with hypotheses"]
"""Further columns, where trainings with hypotheses were made."""


@dataclass(frozen=True, kw_only=True)
class Room:
    """Costs on one real system, on the same unseen episodes.

    Args:
        system: names of what the real system has beside its twin; empty for what the twin knows.
        oracle: J_a of the best policy of the class, by exact gradients on the true system.
        planned: J_a of the policies that trainings have planned on the twin that they fitted, one for each seed.
        said: J_a that the twin predicted of them over virtual episodes, one for each seed.
        classical: J_a of classical controllers, by name.
        helped: as ``planned``, of trainings with hypotheses and the referee that weighs evidence; none were made by
            default.
        paid: sum of J_a of the real episodes of each training of ``planned``.
        helped_paid: the same of each training of ``helped``.
    """

    system: str
    oracle: float
    planned: list[float]
    said: list[float]
    classical: dict[str, float]
    helped: list[float] = field(default_factory=list)
    paid: list[float] = field(default_factory=list)
    helped_paid: list[float] = field(default_factory=list)

    @property
    def best(self) -> float:
        """The least cost of any policy that was found; a descent of the oracle may end in a poor minimum."""
        return min(self.oracle, *self.planned, *self.helped)

    @property
    def gap(self) -> float:
        """Median cost of the planned policies over the least one, minus one."""
        return self.over_best(self.planned)

    def over_best(self, costs: Sequence[float]) -> float:
        """Median of some costs over the least one, minus one."""
        return statistics.median(costs) / self.best - 1.0

    def cells(self) -> list[str]:
        """A row of the table."""
        others = ", ".join(f"{name} {cost:.4g}" for name, cost in self.classical.items())
        return [
            self.system or "as the twin",
            f"{self.best:.4g}",
            with_range(self.planned),
            f"{100.0 * self.gap:.1f} %",
            f"{statistics.median(self.said):.4g}",
            others or "–",
            "yes" if self.gap >= LEAST else "no room",
            *self.helped_cells(),
        ]

    def helped_cells(self) -> list[str]:
        """The part of the row about trainings with hypotheses; empty if none were made."""
        if not self.helped:
            return []
        paid = ", ".join(f"{statistics.median(sums):.3g}" for sums in (self.paid, self.helped_paid))
        return [with_range(self.helped), f"{100.0 * self.over_best(self.helped):.1f} %", paid]


def with_range(costs: Sequence[float]) -> str:
    """The median of some costs, with their range if there are several."""
    spread = f" ({min(costs):.4g} … {max(costs):.4g})" if len(costs) > 1 else ""
    return f"{statistics.median(costs):.4g}{spread}"


def room_table(rows: Sequence[Room]) -> str:
    """The table of several systems, as Markdown."""
    from rt_torchrl.study.tables import table  # here, because the help of a recipe need not wait for Matplotlib

    header = [*HEADER, *HELPED] if any(row.helped for row in rows) else HEADER
    return table(header, [row.cells() for row in rows])


def require_page(page: Path | None) -> None:
    """Refuse a page that :func:`write_into` could not write, before the work whose findings it is to hold.

    Args:
        page: page; None for no page.

    Raises:
        ValueError: if the page cannot be read, or its folder cannot be written.
    """
    if page is None:
        return
    try:
        page.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"page={page} cannot be read ({error}); give a text that exists.") from error
    folder = page.absolute().parent  # in which the new page takes the place of the old one
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"page={page} cannot be written, because the folder {folder} cannot; choose another page.")


def write_into(page: Path, title: str, text: str) -> None:
    """Replace a marked part of a page, or add it at the end.

    The part stands between the lines ``<!-- TITLE -->`` and ``<!-- end of TITLE -->``.

    Raises:
        ValueError: if the page cannot be read or written.
    """
    begin, end = f"<!-- {title} -->", f"<!-- end of {title} -->"
    part = f"{begin}\n\n{text}\n\n{end}"
    try:
        old = page.read_text(encoding="utf-8")
        pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
        new = pattern.sub(lambda _: part, old) if pattern.search(old) else f"{old.rstrip()}\n\n{part}\n"
        write_atomically(page, new.encode())
    except OSError as error:
        raise ValueError(f"page={page} cannot be read or written ({error}); give a page that exists.") from error
