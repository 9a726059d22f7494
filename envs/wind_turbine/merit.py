"""The quantities by which a wind engineer judges an episode."""

from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor

if TYPE_CHECKING:
    from rt_torchrl.envs.wind_turbine.plant import WindTurbine


def merit(
    plant: "WindTurbine",
    states: Float[Tensor, "batch samples n_s"],
    applied: Float[Tensor, "batch n 2"],
    exogenous: Float[Tensor, "batch n n_z"],
) -> dict[str, Float[Tensor, " batch"]]:
    """Mean and deviation of generator power, RMS of the speed above rated, top speed, and travel of the blade pitch."""
    speed = plant.gear_ratio * states[..., 0]
    power = plant.generator_power(states[:, :-1], applied)
    return {
        "mean power [MW]": 1e-6 * power.mean(-1),
        "power deviation [MW]": 1e-6 * power.std(-1),
        "speed above rated [rad/s]": (speed - plant.rated_generator_speed).clamp(min=0.0).square().mean(-1).sqrt(),
        "top generator speed [rad/s]": speed.amax(-1),
        "pitch travel [deg/s]": applied[..., 1].diff(dim=-1).abs().mean(-1) / plant.dt,
    }


def setpoints(
    plant: "WindTurbine",
    states: Float[Tensor, "*batch n n_s"],
    applied: Float[Tensor, "*batch n 2"],
    exogenous: Float[Tensor, "*batch n n_z"],
) -> dict[str, tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]]:
    """Generator speed and power with the references that the paper's cost follows (paper, eqs. omega_ref and P_ref)."""
    omega_g = plant.gear_ratio * states[..., 0]
    return {
        "generator speed [rad/s]": (omega_g, plant.reference_speed(states[..., 2])),
        "power [MW]": (1e-6 * plant.generator_power(states, applied), 1e-6 * plant.reference_power(omega_g)),
    }
