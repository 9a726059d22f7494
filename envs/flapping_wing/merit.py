"""The quantities by which the operator of a drone judges a flight."""

from typing import TYPE_CHECKING

from jaxtyping import Bool, Float
from torch import Tensor

from rt_torchrl.envs.flapping_wing.costs import HOVER_AMPLITUDE

if TYPE_CHECKING:
    from rt_torchrl.envs.flapping_wing.plant import FlappingWing


def merit(
    plant: "FlappingWing",
    states: Float[Tensor, "batch samples n_s"],
    applied: Float[Tensor, "batch n 2"],
    exogenous: Float[Tensor, "batch n 1"],
) -> dict[str, Float[Tensor, " batch"]]:
    """Distance to the target at the end and its least value, mean power of the wings, and travel of the stroke plane.

    The power is that of the amplitude cubed, as a share of the power that carries the weight.
    """
    distance = (plant.target - states[..., :2]).norm(dim=-1)
    return {
        "final distance [m]": distance[:, -1],
        "least distance [m]": distance.amin(-1),
        "wing power [-]": ((applied[..., 0] / HOVER_AMPLITUDE) ** 3).mean(-1),
        "stroke plane travel [deg/s]": applied[..., 1].diff(dim=-1).abs().mean(-1) / plant.dt,
    }


def categories(plant: "FlappingWing", exogenous: Float[Tensor, "batch n 1"]) -> dict[str, Bool[Tensor, " batch"]]:
    """Whether the stroke plane can turn far enough for the wind of the last second, when the drone should hover.

    In a stronger gust every policy is blown away from the target, and the distance says nothing of the policy.
    """
    last = round(1.0 / plant.dt)
    held = exogenous[:, -last:, 0].amax(-1) <= plant.strongest_wind
    return {"gust can be held": held, "gust too strong to hold": ~held}


def setpoints(
    plant: "FlappingWing",
    states: Float[Tensor, "*batch n n_s"],
    applied: Float[Tensor, "*batch n 2"],
    exogenous: Float[Tensor, "*batch n n_z"],
) -> dict[str, tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]]:
    """Both coordinates, with those of the target."""
    place, target = states[..., :2], plant.target.expand_as(states[..., :2])
    return {f"{axis} [m]": (place[..., k], target[..., k]) for k, axis in enumerate(("x", "z"))}
