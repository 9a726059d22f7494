"""The ratios that a reader asks for first, from the cells of a benchmark."""

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarking.case import Case
from benchmarking.contenders import QUANTITIES, Quantity, quantities_of
from benchmarking.sizes import Size
from benchmarking.timing import Cell

RIVALS = {
    "jax_scan": "jitted JAX scan",
    "jax_sweep": "JAX at its best",
    "casadi_scalar": "CasADi, scalar",
    "casadi_lanes": "CasADi with vectors",
    "odeint_adjoint": "odeint_adjoint",
}
BATCHES, LONG = (5, 25, 125), 10_000
DRONE = Case("flapping_wing")
FLAT = (1_000, 100_000)
"""Horizons over which the cost per step shall stay the same."""


@dataclass(frozen=True)
class Summary:
    """Ratios of the first contender of a benchmark to the others.

    Args:
        cells: all cells.
        subject: contender that is compared with the others.
    """

    cells: Sequence[Cell]
    subject: str

    def lines(self) -> list[str]:
        """One line for each ratio; a ratio whose cells are missing is named with the reason."""
        cases = list(dict.fromkeys(cell.size.case for cell in self.cells))
        lines = [
            self._against(rival, quantity, batch)
            for rival in RIVALS
            for quantity in QUANTITIES
            for batch in BATCHES
            if DRONE in cases and rival != self.subject and quantity in quantities_of(rival)
        ]
        lines += [line for case in cases if "mlp" in (case.closure, case.policy) for line in self._perceptrons(case)]
        lines += [line for case in cases for line in self._two_threads(case)]
        return lines + [line for case in cases for line in self._flatness(case)]

    def _against(self, rival: str, quantity: Quantity, batch: int) -> str:
        what = f"drone, {quantity}, {LONG} steps, {batch} realisations, 1 thread: {self.subject} over {RIVALS[rival]}"
        size = Size(DRONE, 1, LONG, batch)
        return f"{what}: {self._ratio(size, quantity, rival)}"

    def _perceptrons(self, case: Case) -> list[str]:
        if self.subject == "parallel":
            return []
        sizes = [size for size in self._sizes(case, self.subject) if size.threads == 1]
        if not sizes:
            return []
        size = max(sizes, key=lambda size: (size.steps, size.realisations))
        what = f"{case.name}, gradient, {size.steps} steps, {size.realisations} realisations, 1 thread"
        return [f"{what}: {self.subject} over parallel: {self._ratio(size, 'gradient', 'parallel')}"]

    def _ratio(self, size: Size, quantity: Quantity, rival: str) -> str:
        own = self._cell(size, self.subject, quantity)
        if own is None:
            return f"not measured ({self._reason(size, self.subject, quantity)})"
        other, note = self._cell(size, rival, quantity), ""
        factor = 1.0
        if other is None:
            other = self._shorter(size, rival, quantity)
            if other is None:
                return f"not measured ({self._reason(size, rival, quantity)})"
            factor = size.steps / other.size.steps
            note = f", {rival} scaled per step from {other.size.steps} steps"
        wall, cpu = factor * other.wall / own.wall, factor * other.cpu / own.cpu
        return f"{wall:.3g} times as fast by wall time, {cpu:.3g} by CPU time{note}"

    def _two_threads(self, case: Case) -> list[str]:
        """By medians and by minima, which other work on the machine disturbs less."""
        lines = []
        for contender in dict.fromkeys(cell.contender for cell in self.cells):
            for size in self._sizes(case, contender):
                two, one = (self._cell(self._on(size, number), contender, "gradient") for number in (2, 1))
                if size.threads == 2 and two and one:
                    where = f"{case.name}, gradient, {size.steps} steps, {size.realisations} realisations"
                    ratio = f"{one.wall / two.wall:.3g} times as fast as on 1, by minima {one.least / two.least:.3g}"
                    lines.append(f"{where}: {contender} on 2 threads is {ratio}")
        return lines

    def _flatness(self, case: Case) -> list[str]:
        """Cost per step at each horizon over that at the shortest one of at least a thousand steps."""
        lines = []
        for quantity in QUANTITIES:
            line = self._line(case, quantity)
            if len(line) > 1:
                per_step = {cell.size.steps: 1e6 * cell.cpu / cell.size.steps for cell in line}
                shown = ", ".join(f"{value:.3g} us at {steps}" for steps, value in per_step.items())
                spread = max(per_step.values()) / min(per_step.values())
                lines.append(
                    f"{case.name}, {quantity}: {self.subject}, CPU per step {shown}; greatest over least {spread:.3g}"
                )
        return lines

    def _line(self, case: Case, quantity: Quantity) -> list[Cell]:
        found = [
            cell
            for cell in self.cells
            if (cell.contender, cell.quantity, cell.size.case, cell.size.threads) == (self.subject, quantity, case, 1)
            and not cell.left_out
            and FLAT[0] <= cell.size.steps <= FLAT[1]
        ]
        batches = [cell.size.realisations for cell in found]
        common = max(set(batches), key=batches.count) if batches else 0
        line = [cell for cell in found if cell.size.realisations == common]
        return sorted(line, key=lambda cell: cell.size.steps)

    def _sizes(self, case: Case, contender: str) -> list[Size]:
        found = {
            cell.size
            for cell in self.cells
            if (cell.contender, cell.size.case) == (contender, case) and not cell.left_out
        }
        return sorted(found, key=lambda size: (size.threads, size.work))

    @staticmethod
    def _on(size: Size, threads: int) -> Size:
        return Size(size.case, threads, size.steps, size.realisations)

    def _cell(self, size: Size, contender: str, quantity: Quantity) -> Cell | None:
        same = (size, contender, quantity)
        return next((c for c in self.cells if (c.size, c.contender, c.quantity) == same and not c.left_out), None)

    def _shorter(self, size: Size, contender: str, quantity: Quantity) -> Cell | None:
        """The cell of the same realisations with the longest shorter horizon."""
        found = [
            cell
            for cell in self.cells
            if (cell.contender, cell.quantity, cell.size.case) == (contender, quantity, size.case)
            and (cell.size.threads, cell.size.realisations) == (size.threads, size.realisations)
            and cell.size.steps < size.steps
            and not cell.left_out
        ]
        return max(found, key=lambda cell: cell.size.steps, default=None)

    def _reason(self, size: Size, contender: str, quantity: Quantity) -> str:
        same = (size, contender, quantity)
        left_out = [c.left_out for c in self.cells if (c.size, c.contender, c.quantity) == same]
        return left_out[0] if left_out else "this size was not asked for"
