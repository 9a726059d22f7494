"""What the operator of a drone judges a flight by."""

from jaxtyping import Float
from torch import Tensor

from rt_torchrl.plant import Plant


def merit(
    plant: Plant,
    states: Float[Tensor, "batch samples 4"],
    applied: Float[Tensor, "batch n 2"],
    exogenous: Float[Tensor, "batch n 1"],
) -> dict[str, Float[Tensor, " batch"]]:
    """Distance to the target at the end and at its least, and whether the last second's wind could be held."""
    distance = (plant.target - states[..., :2]).norm(dim=-1)
    last = round(1.0 / plant.dt)
    return {
        "final distance [m]": distance[:, -1],
        "least distance [m]": distance.amin(-1),
        "gust can be held [-]": (exogenous[:, -last:, 0].amax(-1) <= plant.strongest_wind).double(),
    }
