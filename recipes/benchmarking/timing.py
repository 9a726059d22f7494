"""Times of the contenders, which take turns in one process."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from benchmarking import cores
from benchmarking.case import System, scenario_of, system_of
from benchmarking.contenders import QUANTITIES, Calls, Contenders, Quantity, made_once, quantities_of
from benchmarking.sizes import Size
from rt_torchrl import DivergenceError

Runner = tuple[str, Size]
"""A contender at a size, of which the threads are a part."""
TURN = 0.1
"""Time [s] that the calls of a turn take together; one call that takes longer is a turn of its own."""


@dataclass(frozen=True)
class Cell:
    """The time of one contender at one size, or the reason why it was not taken.

    Args:
        size: size of the problem.
        contender: name of the contender.
        quantity: forward for the cost, gradient for its gradient by the policy's weights.
        wall: median wall time [s].
        least: least wall time [s].
        cpu: median CPU time of the process [s].
        repeats: number of turns behind the medians; each has as many calls as take a tenth of a second.
        first: wall time of the first evaluation, which may compile [s].
        gap: relative difference of the result from that of the first contender of the cell.
        left_out: reason why there is no time; empty if there is one.
    """

    size: Size
    contender: str
    quantity: Quantity
    wall: float = float("nan")
    least: float = float("nan")
    cpu: float = float("nan")
    repeats: int = 0
    first: float = float("nan")
    gap: float = float("nan")
    left_out: str = ""

    def record(self) -> dict[str, Any]:
        """The cell for a JSON file."""
        case = self.size.case
        where = {"plant": case.plant, "closure": case.closure, "policy": case.policy, "threads": self.size.threads}
        where |= {"steps": self.size.steps, "realisations": self.size.realisations}
        where |= {"contender": self.contender, "quantity": self.quantity}
        if self.left_out:
            return where | {"left_out": self.left_out}
        names = ("wall", "least", "cpu", "repeats", "first", "gap")
        return where | {name: getattr(self, name) for name in names}


@dataclass
class Stopwatch:
    """Times all contenders at one size after another; numbers of threads take turns too.

    Args:
        contenders: the contenders.
        repeats: greatest number of timed evaluations in each cell.
        limit: time [s] above which a cell is left out by its prediction, and after which it is repeated no more.
        tell: function that is called with what is being done.
    """

    contenders: Contenders
    repeats: int
    limit: float
    tell: Callable[[str], None]
    cells: list[Cell] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._made = made_once(self.contenders)
        self._systems: dict[Any, System] = {}

    def time(self, sizes: Sequence[Size], names: Sequence[str] = ()) -> list[Cell]:
        """The cells at sizes that differ in the threads alone; they are also added to ``cells``.

        Args:
            sizes: sizes of the problem.
            names: contenders to be timed; by default all.
        """
        case, steps, realisations = sizes[0].case, sizes[0].steps, sizes[0].realisations
        system = self._systems.setdefault(case, system_of(case))
        scenario = scenario_of(system.case, steps, realisations)
        calls: dict[str, Calls] = {}
        found: list[Cell] = []
        for quantity in QUANTITIES:
            able: dict[Runner, Callable[[], Any]] = {}
            for name, size in product(names or self.contenders.names, sizes):
                if quantity not in quantities_of(name):
                    continue
                reason = self.contenders.refusal(name, system) or self._too_long(size, name, quantity)
                if reason:
                    found.append(Cell(size, name, quantity, left_out=reason))
                    continue
                if name not in calls:
                    calls[name] = self._made(name, system).calls(scenario)
                able[name, size] = getattr(calls[name], quantity)
            found += self._in_turn(quantity, able)
        self.cells += found
        return found

    def predicted(self, size: Size, contender: str, quantity: Quantity) -> float:
        """Wall time [s] that other sizes predict at most; NaN if none has been timed.

        It is in proportion to the steps and to more realisations; fewer realisations may take as long.
        """
        found = [
            cell.wall * size.steps / cell.size.steps * max(1.0, size.realisations / cell.size.realisations)
            for cell in self.cells
            if (cell.contender, cell.quantity, cell.size.case) == (contender, quantity, size.case)
            and cell.size.threads == size.threads
            and not cell.left_out
        ]
        return min(found, default=float("nan"))

    def _too_long(self, size: Size, name: str, quantity: Quantity) -> str:
        seconds = self.predicted(size, name, quantity)
        return f"about {seconds:.3g} s predicted, limit {self.limit:g} s" if seconds > self.limit else ""

    def _in_turn(self, quantity: Quantity, functions: dict[Runner, Callable[[], Any]]) -> list[Cell]:
        results, first = {}, {}
        wall: dict[Runner, list[float]] = {runner: [] for runner in functions}
        cpu: dict[Runner, list[float]] = {runner: [] for runner in functions}
        for (name, size), function in functions.items():
            self.tell(f"{size.case.name}: {name}, {quantity}, {size.steps} x {size.realisations}")
            with cores.torch_threads(size.threads):
                start = time.perf_counter()
                found = _finite(function)
            if found is not None:
                results[name, size], first[name, size] = found, time.perf_counter() - start
        calls: dict[Runner, int] = {}
        for _ in range(self.repeats):
            for runner in results:
                if sum(wall[runner]) <= self.limit:
                    with cores.torch_threads(runner[1].threads), cores.limited_to(runner[1].threads):
                        calls[runner] = calls.get(runner) or _calls_of_a_turn(functions[runner])
                        _clock(functions[runner], calls[runner], wall[runner], cpu[runner])
        reference = next(iter(results.values()), None)
        diverged = [
            Cell(size, name, quantity, left_out="diverged") for name, size in functions if (name, size) not in results
        ]
        return diverged + [
            Cell(
                size,
                name,
                quantity,
                statistics.median(wall[name, size]),
                min(wall[name, size]),
                statistics.median(cpu[name, size]),
                len(wall[name, size]),
                first[name, size],
                float(np.linalg.norm(found - reference) / np.linalg.norm(reference)),
            )
            for (name, size), found in results.items()
        ]


def _finite(function: Callable[[], Any]) -> np.ndarray | None:
    """A result; None if it is not finite."""
    try:
        result = np.asarray(function())
    except DivergenceError:
        return None
    return result if np.isfinite(result).all() else None


def _calls_of_a_turn(function: Callable[[], Any]) -> int:
    """Number of calls that take ``TURN``, at least one.

    A single call of a millisecond would measure what the contender before it left in the caches.
    """
    start = time.perf_counter()
    function()
    return max(1, round(TURN / (time.perf_counter() - start)))


def _clock(function: Callable[[], Any], calls: int, wall: list[float], cpu: list[float]) -> None:
    """Append the time of one call, the mean over ``calls`` in a row."""
    start, start_cpu = time.perf_counter(), time.process_time()
    for _ in range(calls):
        function()
    wall.append((time.perf_counter() - start) / calls)
    cpu.append((time.process_time() - start_cpu) / calls)
