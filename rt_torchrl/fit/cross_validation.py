"""Cross-validation inside one record: each part of it is simulated by a twin that was identified from the rest."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.fit.record import SensorRecord

Guess = Callable[[Float[Tensor, " n_y"]], Float[Tensor, " n_s"]]
"""Makes the first guess of a state from the readings in its sample."""


class Fold(NamedTuple):
    """A part of a record that is simulated, and the parts that the twin is identified from."""

    training: list[SensorRecord]
    held_out: SensorRecord


def folds(record: SensorRecord, count: int, dt: float, guess: Guess, *, shortest: int = 100) -> list[Fold]:
    """Divide a record into parts of equal length, each of which is held out once.

    Args:
        record: the record.
        count: number of parts.
        dt: control interval [s].
        guess: first guess of the state at the start of a part.
        shortest: number of control intervals that a part needs.

    Raises:
        ValueError: if there are fewer than two parts, or they are too short.
    """
    n = len(record.actions)
    if count < 2 or n // count < shortest:
        raise ValueError(
            f"folds={count} of a record of {n} control intervals must be at least 2, and each at least {shortest} "
            "intervals long."
        )
    cuts = [round(k * n / count) for k in range(count + 1)]

    def part(first: int, last: int) -> SensorRecord:
        return record.part(first, last, dt, guess(record.readings[first]))

    return [
        Fold([part(*ends) for ends in ((0, first), (last, n)) if ends[1] > ends[0]], part(first, last))
        for first, last in zip(cuts[:-1], cuts[1:], strict=True)
    ]


def pooled(rms: list[float], held_out: list[SensorRecord]) -> float:
    """RMS error over all parts together, from those of each part."""
    lengths = torch.tensor([len(record.readings) for record in held_out], dtype=torch.float64)
    squares = torch.tensor(rms, dtype=torch.float64).square()
    return float((lengths * squares).sum() / lengths.sum()) ** 0.5
