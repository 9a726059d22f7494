"""What is wanted of the drone: running costs L_a, each called with the plant, time, state, action and wind."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.options import require_range
from rt_torchrl.plants.plant import RunningCost, require_weights

if TYPE_CHECKING:
    from rt_torchrl.envs.flapping_wing.plant import FlappingWing

Peak = Literal["unit", "printed"]


@dataclass(frozen=True, kw_only=True)
class TrackingCost:
    r"""The paper's cost of the way to the target, and of what the flight takes.

    .. math::
        L_a = \tfrac12\big(\|e\|^2 + \alpha_1\|\dot e\circ h\|^2\big) + w_E\Big(\frac{A_\phi}{A_0}\Big)^3
        + w_\beta\Big(\frac{\dot\beta_w}{1000\,\mathrm{deg/s}}\Big)^2, \qquad
        h_i = \hat h_i\exp\Big[-\frac12\Big(\frac{x_i - x_{f,i}}{\sigma}\Big)^2\Big]

    with the position error e (paper, eq. drone_eq_rewardCont). The power of wings that beat at one frequency goes with
    the cube of their amplitude; A_0 = 77.2 deg carries the weight.

    Note: the paper prints a peak ĥ of x_f²/2; here it is 1, because its text calls the function unitary.
    ``peak="printed"`` gives the printed peak.

    Args:
        velocity: weight α1 of the speed near the target.
        peak: height of the Gaussian window h: 1, or the printed x_f²/2.
        energy: weight w_E of the power of the wings.
        rate: weight w_β of the rate of the stroke plane; a drone with it remembers the angle that it applied last.

    Raises:
        ValueError: if a weight is negative, or the peak is unknown.
    """

    velocity: float = 1.0
    peak: Peak = "unit"
    energy: float = 0.0
    rate: float = 0.0

    def __post_init__(self) -> None:
        require_weights(self)

    def __call__(
        self,
        plant: "FlappingWing",
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch 2"],
        exogenous: Float[Tensor, "*#batch 1"],
    ) -> Float[Tensor, "*batch"]:
        e = plant.target - state[..., :2]
        peak = 1.0 if self.peak == "unit" else 0.5 * plant.target**2
        h = peak * torch.exp(-0.5 * (e / WINDOW_WIDTH) ** 2)
        cost = 0.5 * ((e**2).sum(-1) + self.velocity * ((state[..., 2:4] * h) ** 2).sum(-1))
        if self.energy:
            cost = cost + self.energy * (applied[..., 0] / HOVER_AMPLITUDE) ** 3
        if self.rate:
            cost = cost + self.rate * ((applied[..., 1] - state[..., 4]) / (plant.dt * STROKE_PLANE_RATE)) ** 2
        return cost


WINDOW_WIDTH = 0.71
"""σ of the window h [m]."""
HOVER_AMPLITUDE = 77.2
"""Flapping amplitude A_0 that carries the weight in calm air [deg]."""
STROKE_PLANE_RATE = 1000.0
"""Unit of the rate of the stroke plane [deg/s]."""
SLOWEST = 60.0
"""Rate with which the stroke plane takes a second for its whole range; a flight takes five [deg/s]."""


def needs_memory(cost: RunningCost) -> bool:
    """Whether a cost reads the stroke plane angle that was applied last."""
    return isinstance(cost, TrackingCost) and cost.rate > 0.0


def require_rate(rate: float | None) -> None:
    """Refuse a greatest rate of the stroke plane that is none.

    Raises:
        ValueError: if the rate [deg/s] is not positive, or below ``SLOWEST``.
    """
    if rate is not None and not (rate > 0.0 and math.isfinite(rate)):
        raise ValueError(f"stroke_plane_rate={rate} deg/s must be positive and finite; None means no limit.")
    if rate is not None:
        name, of = "stroke_plane_rate", "the drone"
        require_range(name, rate, SLOWEST, math.inf, unit="deg/s", of=of)
