"""What the operator of a drone judges a flight by."""

from typing import TYPE_CHECKING

from jaxtyping import Bool, Float
from torch import Tensor

if TYPE_CHECKING:
    from rt_torchrl.envs.flapping_wing.plant import FlappingWing


def merit(
    plant: "FlappingWing",
    states: Float[Tensor, "batch samples 4"],
    applied: Float[Tensor, "batch n 2"],
    exogenous: Float[Tensor, "batch n 1"],
) -> dict[str, Float[Tensor, " batch"]]:
    """Distance to the target at the end and at its least."""
    distance = (plant.target - states[..., :2]).norm(dim=-1)
    return {"final distance [m]": distance[:, -1], "least distance [m]": distance.amin(-1)}


def categories(plant: "FlappingWing", exogenous: Float[Tensor, "batch n 1"]) -> dict[str, Bool[Tensor, " batch"]]:
    """Whether the stroke plane turns far enough to hold the wind of the last second, when the drone should hover.

    No policy stays at the target in a gust beyond that; it is blown away, and how far says nothing of the policy.
    """
    last = round(1.0 / plant.dt)
    held = exogenous[:, -last:, 0].amax(-1) <= plant.strongest_wind
    return {"gust can be held": held, "gust too strong to hold": ~held}
