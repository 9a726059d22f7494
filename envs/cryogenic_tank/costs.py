"""What is wanted of the tank: a running cost L_a and a terminal cost, called with the plant and its signals."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.envs.cryogenic_tank.vent import valve_conductance
from rt_torchrl.options import require_range
from rt_torchrl.plants.plant import RunningCost, require_weights

if TYPE_CHECKING:
    from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank


@runtime_checkable
class TankCost(RunningCost, Protocol):
    """A running and a terminal cost of the tank, of any batch dimensions; neither must be negative."""

    def terminal(self, plant: "CryogenicTank", state: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]: ...


@dataclass(frozen=True, kw_only=True)
class PressureCost:
    r"""The paper's cost α_1 e² + α_2 ṁ_c (paper, eq. cryo_J_a), and the cost T_e e² of the pressure at the end.

    Without the latter the optimum stops venting 12 h before the end, because nobody pays for the pressure that it
    leaves.

    Note: in the paper ṁ_c is that of the twin's own valve; here it is that of a valve with the rated K_JT, in the
    real plant and in the twin, because a cost is a function of state and action alone.

    Args:
        error: weight α1 [-] of the pressure error e in 10 kPa.
        vented: weight α2 [s/kg] of the vented mass. With 5000 s/kg it weighs a tenth of the tracking error under the
            random policies that a training starts from.
        end: weight T_e [s] of the pressure error at the end, which costs as much as if it lasted for that time.

    Raises:
        ValueError: if a weight is negative or not finite.
    """

    error: float = 1.0
    vented: float = 5000.0
    end: float = 0.0

    def __post_init__(self) -> None:
        require_weights(self)

    def __call__(
        self,
        plant: "CryogenicTank",
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch 3"],
        applied: Float[Tensor, "*batch 1"],
        exogenous: Float[Tensor, "*#batch 1"],
    ) -> Float[Tensor, "*batch"]:
        p, (open_drop, share) = state[..., 2], plant.command.opening(applied[..., 0])
        drop = p - plant.valve_outlet(p, open_drop)
        flow = share * drop * valve_conductance(drop, torch.full_like(drop, plant.rated_valve))
        e = (p - plant.set_point) / plant.error_unit
        return self.error * e**2 + self.vented * flow

    def terminal(self, plant: "CryogenicTank", state: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self.end * ((state[..., 2] - plant.set_point) / plant.error_unit) ** 2


SIZES = (
    (1e-6, 20.0, "K"),
    (1e-6, 10.0, "m³"),
    (10.0, 1e6, "Pa"),
)
"""Errors of a tank of 60 m³ at 80 to 900 kPa: least and greatest one, and unit."""


def require_sizes(sizes: tuple[float, float, float]) -> None:
    """Refuse errors of T_s [K], V_l [m³] and p [Pa] that weigh the same but have no size.

    Raises:
        ValueError: if one is not positive, or one that this tank cannot have.
    """
    if not all(0.0 < size < math.inf for size in sizes):
        raise ValueError(f"error_sizes={sizes} (K, m³, Pa) must be positive and finite.")
    for size, (least, greatest, unit) in zip(sizes, SIZES, strict=True):
        require_range("error_sizes", size, least, greatest, unit=unit, of="the tank")
