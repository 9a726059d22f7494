"""How much a policy could cost less than one that is planned on a twin which does not know the real system."""

import re
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rt_torchrl.atomic_file import write_atomically

LEAST = 0.03
"""Gap below which a system is no evidence for or against a method."""
HEADER = ["system", "oracle", "planned, median (range)", "gap", "twin says", "classical", "room"]


@dataclass(frozen=True, kw_only=True)
class Room:
    """Costs on one real system, on the same unseen episodes.

    Args:
        system: names of what the real system has beside its twin; empty for what the twin knows.
        oracle: J_a of the best policy of the class, by exact gradients on the true system.
        planned: J_a of the policies that trainings have planned on the twin that they fitted, one for each seed.
        said: J_a that the twin predicted of them over virtual episodes, one for each seed.
        classical: J_a of classical controllers, by name.
    """

    system: str
    oracle: float
    planned: list[float]
    said: list[float]
    classical: dict[str, float]

    @property
    def best(self) -> float:
        """The least cost of any policy that was found; a descent of the oracle may end in a poor minimum."""
        return min(self.oracle, *self.planned)

    @property
    def gap(self) -> float:
        """Median cost of the planned policies over the least one, minus one."""
        return statistics.median(self.planned) / self.best - 1.0

    def cells(self) -> list[str]:
        """A row of the table."""
        spread = f" ({min(self.planned):.4g} … {max(self.planned):.4g})" if len(self.planned) > 1 else ""
        others = ", ".join(f"{name} {cost:.4g}" for name, cost in self.classical.items())
        return [
            self.system or "as the twin",
            f"{self.best:.4g}",
            f"{statistics.median(self.planned):.4g}{spread}",
            f"{100.0 * self.gap:.1f} %",
            f"{statistics.median(self.said):.4g}",
            others or "–",
            "yes" if self.gap >= LEAST else "no room",
        ]


def room_table(rows: Sequence[Room]) -> str:
    """The table of several systems, as Markdown."""
    from rt_torchrl.study.tables import table  # here, because the help of a recipe need not wait for Matplotlib

    return table(HEADER, [row.cells() for row in rows])


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
