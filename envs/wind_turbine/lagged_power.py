"""A rotor whose power follows the wind and the blades with a lag that a twin identifies."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.plants.closures import FACTOR, PositiveCoefficients
from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

MEGA = 1e6
START = 0.4
"""C_p at the start of an episode [-]."""


class LaggedPower(Extension):
    r"""A turbine whose rotor takes a power P out of the wind that follows the quasi-steady one with a time constant T.

    .. math:: T\dot P = \tau_a\omega_r - P, \qquad J\dot\omega_r = P/\omega_r - N_g\tau_g

    :class:`LaggedCoefficients` would let C_p lag alone, while the torque follows u² at once.

    Args:
        base: the turbine.
        time_constant: T [s] with which the identification begins.

    Raises:
        ValueError: if the time constant is not positive and finite.
    """

    base: WindTurbine

    def __init__(self, base: WindTurbine, time_constant: float):
        meanings = {"force_lag": "time constant of the rotor's power"}
        own = PositiveCoefficients([time_constant], names={"force_lag": "s"}, meanings=meanings, factor=FACTOR)
        super().__init__(base, [Signal(symbol="P", name="lagged_power", unit="MW")], own.requires_grad_(False))

    advance = Plant.advance

    def vector_field(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        action: Float[Tensor, "*batch 2"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        base, hidden = self.split(state)
        plant, inner, u = self.base, self.of_base(closure), exogenous[..., 0]
        # The floor is that of the torque, where the rotor hardly turns.
        speed = torch.maximum(base[..., 0], plant.least_tip_speed_ratio * u / plant.radius)
        torque = plant.aerodynamic_torque(base[..., 0], action[..., 1], u, inner)
        missing = hidden[..., 0] * MEGA / speed - torque
        field = plant.vector_field(t, base, action, exogenous, inner)
        accelerated = field[..., :1] + (missing / plant.inertia).unsqueeze(-1)
        rate = -(missing * speed).unsqueeze(-1) / (MEGA * self.coefficients(closure)[0])
        return torch.cat([accelerated, field[..., 1:], rate], -1)

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Float[Tensor, "*batch 1"]:
        """The power of a usual C_p in the filtered wind."""
        plant, wind = self.base, base[..., 2]
        power = 0.5 * plant.air_density * torch.pi * plant.radius**2 * START * wind**3
        return (power / MEGA).unsqueeze(-1)
