"""One scalar of a plant: its symbol, unit and range."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.options import require_number

Values = TypeVar("Values", Tensor, np.ndarray)


@dataclass(frozen=True, kw_only=True)
class Signal:
    r"""A component of a state, action, exogenous input or observation.

    Args:
        symbol: letter in formulas, as matplotlib mathtext without the dollars (``r"\omega_r"``).
        name: word in interfaces, a valid identifier (``"rotor_speed"``).
        unit: SI unit, or the unit a correlation is defined in (``"rad/s"``, ``"deg"``, ``"-"``).
        low: least admissible value in ``unit``.
        high: greatest admissible value in ``unit``.
        periodic: whether the range is one turn of a state such as an angle, so that ``low`` and ``high`` are the same
            place.

    Raises:
        ValueError: if the name is no identifier, the range is empty, or a periodic signal has no finite range.
    """

    symbol: str
    name: str
    unit: str
    low: float = -math.inf
    high: float = math.inf
    periodic: bool = False

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"Signal name={self.name!r} must be an identifier such as 'rotor_speed'; rename it.")
        for end in ("low", "high"):
            require_number(end, getattr(self, end), finite=False)
        if not self.low < self.high:
            raise ValueError(
                f"Signal {self.name!r} has low={self.low}, high={self.high} [{self.unit}]; low must be below high."
            )
        if self.periodic and not math.isfinite(self.period):
            raise ValueError(
                f"Signal {self.name!r} is periodic with low={self.low}, high={self.high} [{self.unit}]; both must be "
                "finite, one turn apart."
            )

    @property
    def period(self) -> float:
        """One turn of a periodic signal, in ``unit``."""
        return self.high - self.low

    def wrapped(self, values: Values) -> Values:
        """The values, moved into the range by whole turns if the signal is periodic."""
        return self.low + (values - self.low) % self.period if self.periodic else values

    def short_way(self, change: Values) -> Values:
        """The change, reduced to at most half a turn either way if the signal is periodic."""
        return (change + 0.5 * self.period) % self.period - 0.5 * self.period if self.periodic else change

    @property
    def label(self) -> str:
        r"""Axis label, such as ``rotor speed $\omega_r$ [rad/s]``."""
        return f"{self.name.replace('_', ' ')} ${self.symbol}$ [{self.unit}]"


def differences(
    signals: Sequence[Signal], first: Float[Tensor, "*batch n"], second: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch n"]:
    """The differences ``first`` − ``second``, taken the short way round where a signal is periodic."""
    changes = (first - second).unbind(-1)
    return torch.stack([signal.short_way(change) for signal, change in zip(signals, changes, strict=True)], -1)


def bounds(
    signals: Sequence[Signal], *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Least and greatest admissible values of the signals, in their units."""
    low, high = (
        torch.tensor([getattr(signal, end) for signal in signals], dtype=dtype, device=device)
        for end in ("low", "high")
    )
    return low, high
