"""One scalar of a plant: its symbol, unit and range."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Signal:
    r"""A component of a state, action, exogenous input or observation.

    Args:
        symbol: the letter of the formulas, as matplotlib mathtext without the dollars (``r"\omega_r"``).
        name: the word of the interfaces, a valid identifier (``"rotor_speed"``).
        unit: SI unit, or the unit a correlation is defined in (``"rad/s"``, ``"deg"``, ``"-"``).
        low: least admissible value in ``unit``.
        high: greatest admissible value in ``unit``.
    """

    symbol: str
    name: str
    unit: str
    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"Signal name={self.name!r} must be an identifier such as 'rotor_speed'; rename it.")
        if not self.low < self.high:
            raise ValueError(
                f"Signal {self.name!r} has low={self.low}, high={self.high} [{self.unit}]; low must be below high."
            )

    @property
    def label(self) -> str:
        r"""Axis label, such as ``rotor speed $\omega_r$ [rad/s]``."""
        return f"{self.name.replace('_', ' ')} ${self.symbol}$ [{self.unit}]"


def bounds(
    signals: Sequence[Signal], *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Least and greatest admissible values of the signals, in their units."""
    low, high = (
        torch.tensor([getattr(signal, end) for signal in signals], dtype=dtype, device=device)
        for end in ("low", "high")
    )
    return low, high
