"""What a policy commands of the vent's valve.

``opening`` gives the pressure drop [Pa] of the valve while it is open, and the share of the interval in which it is
open; ``of_drop`` gives the action that a controller of the pressure drop [Pa] asks for.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.plants.signal import Signal

GREATEST_DROP = 200e3
"""Pressure drop of the open valve [Pa]."""


@dataclass(frozen=True)
class Drop:
    """The pressure drop of a valve that is held half open."""

    signal: Signal = Signal(symbol=r"\Delta p_V", name="valve_drop", unit="Pa", low=0.0, high=GREATEST_DROP)

    def opening(self, action: Float[Tensor, "*batch"]) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        return action, torch.ones_like(action)

    def of_drop(self, drop: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        return drop


@dataclass(frozen=True)
class Duty:
    """The duty cycle of a valve that is either shut or open, with flows that are means over the interval."""

    signal: Signal = Signal(symbol="d", name="duty_cycle", unit="-", low=0.0, high=1.0)

    def opening(self, action: Float[Tensor, "*batch"]) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        return torch.full_like(action, GREATEST_DROP), action

    def of_drop(self, drop: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        return drop / GREATEST_DROP


COMMANDS: dict[str, Drop | Duty] = {"drop": Drop(), "duty": Duty()}
"""The kinds of action by their names."""
