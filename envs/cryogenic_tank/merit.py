"""The quantities by which the operator of a tank judges an episode."""

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

if TYPE_CHECKING:
    from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank

SETTLED_SHARE = 0.6
"""Share of an episode after which the pressure should be held: three of five days."""
BAND = 5e3
"""Half width [Pa] of the band in which the pressure should be held."""


def merit(
    plant: "CryogenicTank",
    states: Float[Tensor, "batch samples 3"],
    applied: Float[Tensor, "batch n 1"],
    exogenous: Float[Tensor, "batch n 1"],
) -> dict[str, Float[Tensor, " batch"]]:
    """Largest pressure error after three of five days, whether it is within the band, and the mass vented."""
    settled = states[:, round(SETTLED_SHARE * applied.shape[1]) :, 2]
    error = (settled - plant.set_point).abs().amax(-1)
    return {
        "late pressure error [kPa]": 1e-3 * error,
        "held within 5 kPa [-]": (error <= BAND).double(),
        "vented mass [kg]": plant.vented_mass(states, applied, plant.closure)[:, -1],
    }


def setpoints(
    plant: "CryogenicTank",
    states: Float[Tensor, "*batch n 3"],
    applied: Float[Tensor, "*batch n 1"],
    exogenous: Float[Tensor, "*batch n n_z"],
) -> dict[str, tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]]:
    """Pressure, which should be held at the set point."""
    pressure = 1e-3 * states[..., 2]
    return {"pressure [kPa]": (pressure, torch.full_like(pressure, 1e-3 * plant.set_point))}
