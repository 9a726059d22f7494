"""A rotor whose torque follows the wind with a lag, because its wake does."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal


class LaggedTorque(Extension):
    r"""A turbine whose rotor feels a torque τ that follows the quasi-steady torque with a time constant T.

    .. math:: T\dot\tau = \tau_a(\omega_r, \beta, u) - \tau, \qquad J\dot\omega_r = \tau - N_g\tau_g

    This is the crudest model of dynamic inflow: the wake takes the time D/u to change, and the torque follows it.

    Args:
        base: the turbine.
        time_constant: T [s].

    Raises:
        ValueError: if the time constant is not positive and finite.
    """

    base: WindTurbine

    def __init__(self, base: WindTurbine, time_constant: float):
        if not 0.0 < time_constant < math.inf:
            raise ValueError(f"time_constant={time_constant} s of the torque must be positive and finite.")
        super().__init__(base, [Signal(symbol=r"\tau", name="lagged_torque", unit="N m")])
        self.time_constant = time_constant

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
        quasi_steady = self.base.aerodynamic_torque(base[..., 0], action[..., 1], exogenous[..., 0], closure)
        missing = hidden[..., 0] - quasi_steady
        field = self.base.vector_field(t, base, action, exogenous, closure)
        accelerated = field[..., :1] + (missing / self.base.inertia).unsqueeze(-1)
        return torch.cat([accelerated, field[..., 1:], -missing.unsqueeze(-1) / self.time_constant], -1)

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Float[Tensor, "*batch 1"]:
        """The quasi-steady torque in the filtered wind."""
        speed, wind, pitch = base[..., 0], base[..., 2], base[..., 5]
        return self.base.aerodynamic_torque(speed, pitch, wind, self.base.closure).unsqueeze(-1)
