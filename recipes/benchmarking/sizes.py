"""The sizes at which the contenders are timed, in the order of their importance."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from benchmarking.case import Case


@dataclass(frozen=True)
class Size:
    """A case with the number of its intervals, of its realisations and of the threads."""

    case: Case
    threads: int
    steps: int
    realisations: int

    @property
    def work(self) -> int:
        """Number of intervals of all realisations."""
        return self.steps * self.realisations


@dataclass(frozen=True)
class Grid:
    """Two lines of sizes for each case: over horizons and over realisations, or all pairs.

    Args:
        cases: the cases; the first one matters most.
        threads: numbers of threads, which take turns at each size.
        horizons: numbers of intervals.
        realisations: numbers of realisations.
        at_horizon: horizon of the line over realisations.
        at_realisations: number of realisations of the line over horizons.
        all_pairs: whether to take all pairs of horizons and realisations instead.
    """

    cases: Sequence[Case]
    threads: Sequence[int]
    horizons: Sequence[int]
    realisations: Sequence[int]
    at_horizon: int
    at_realisations: int
    all_pairs: bool = False

    def pairs(self) -> list[tuple[int, int]]:
        """Pairs of steps and realisations; the smaller work comes first, because it predicts the time of the larger."""
        if self.all_pairs:
            pairs = set(itertools.product(self.horizons, self.realisations))
        else:
            pairs = {(n, self.at_realisations) for n in self.horizons}
            pairs |= {(self.at_horizon, batch) for batch in self.realisations}
        return sorted(pairs, key=lambda pair: (pair[0] * pair[1], pair))

    def __iter__(self) -> Iterator[list[Size]]:
        """Sizes that take turns, because they differ in the threads alone."""
        for case in self.cases:
            for steps, realisations in self.pairs():
                yield [Size(case, threads, steps, realisations) for threads in self.threads]
