"""A tank that nobody stirs: its surface warms and cools before the rest of the liquid does."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal


class TwoZones(Extension):
    r"""A tank with a pressure p over a surface zone, beside the pressure p_h of the same tank when it is stirred.

    .. math:: p = p_h + (r - 1)(p_h - x), \qquad T_m\dot x = p_h - x

    A fast change of p_h is r times as great at the surface, and after the mixing time T_m the zones are one. The
    balances of the plant are those of the stirred tank; sensor and cost see the pressure p. The hidden state x has its
    exact solution for the mean of p_h over the interval.

    Args:
        base: the tank, whose state 2 is the pressure.
        ratio: ratio r of the rates of pressure.
        mixing_time: T_m [s].

    Raises:
        ValueError: if the ratio is below 1, or the mixing time is not positive and finite.
    """

    def __init__(self, base: Plant, ratio: float, mixing_time: float):
        if not 1.0 <= ratio < math.inf or not 0.0 < mixing_time < math.inf:
            raise ValueError(
                f"ratio={ratio} of the zones must be at least 1, and mixing_time={mixing_time} s positive; both finite."
            )
        super().__init__(base, [Signal(symbol="x", name="mixed_pressure", unit="Pa")])
        self.ratio, self.mixing_time = ratio, mixing_time
        self._left = math.exp(-base.dt / mixing_time)

    def stirred(self, read: Float[Tensor, "*batch 3"], mixed: Float[Tensor, "*batch 1"]) -> Float[Tensor, "*batch 3"]:
        """States of the stirred tank."""
        pressure = (read[..., 2:3] + (self.ratio - 1.0) * mixed) / self.ratio
        return torch.cat([read[..., :2], pressure], -1)

    def at_surface(
        self, stirred: Float[Tensor, "*batch 3"], mixed: Float[Tensor, "*batch 1"]
    ) -> Float[Tensor, "*batch 4"]:
        """States of the tank with its surface zone, or their rates from the rates of the arguments."""
        pressure = self.ratio * stirred[..., 2:3] - (self.ratio - 1.0) * mixed
        return torch.cat([stirred[..., :2], pressure, mixed], -1)

    def vector_field(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch 4"],
        action: Float[Tensor, "*batch 1"],
        exogenous: Float[Tensor, "*#batch 1"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch 4"]:
        read, mixed = self.split(state)
        stirred = self.stirred(read, mixed)
        field = self.base.vector_field(t, stirred, action, exogenous, closure)
        return self.at_surface(field, (stirred[..., 2:3] - mixed) / self.mixing_time)

    def advance(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch 4"],
        applied: Float[Tensor, "*batch 1"],
        exogenous: Float[Tensor, "*#batch 1"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch 4"]:
        read, mixed = self.split(state)
        start = self.stirred(read, mixed)
        end = self.base.advance(t, start, applied, exogenous, closure)
        mean = 0.5 * (start[..., 2:3] + end[..., 2:3])
        return self.at_surface(end, mean + (mixed - mean) * self._left)

    def rest(self, base: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 1"]:
        """Zones that are one."""
        return base[..., 2:3]
