r"""The turbine's filters and last actions, computed from the measured signals: rotor speed, actions and wind.

The filters are first-order lags :math:`T\dot{\hat y} = y - \hat y`, settled at the start of the record:

.. math:: \hat y_{k+1} = e^{-\Delta t/T}\hat y_k + (1 - e^{-\Delta t/T})\,\bar y_k

with :math:`\bar y_k` the held wind, or the mean of the speeds at both ends of the interval.
"""

import math
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.envs.wind_turbine.measurements import FAST_FILTER, FAST_SPEED, STATES
from rt_torchrl.plants.sampling import between, lag

if TYPE_CHECKING:
    from rt_torchrl.envs.wind_turbine.plant import WindTurbine


def completed(
    plant: "WindTurbine",
    measured: dict[str, Float[Tensor, " samples"]],
    exogenous: Float[Tensor, "n n_z"],
    actions: Float[Tensor, "n 2"],
) -> Float[Tensor, "samples n_s"]:
    """All states; the logged values of a filter are used if the log has them."""
    omega_g = plant.gear_ratio * measured["rotor_speed"]
    wind = exogenous[:, 0]
    constant = 1.0 / (2.0 * math.pi * plant.filter_frequency)

    def filtered(name: str, start: Tensor, driving: Tensor, time_constant: float) -> Tensor:
        return measured[name] if name in measured else lag(start, driving, plant.dt / time_constant)

    omega_hat = filtered("filtered_generator_speed", omega_g[0], between(omega_g), constant)
    u_hat = filtered("filtered_wind_speed", wind[0], wind, constant)
    e1 = plant.speed_error(omega_hat, u_hat)
    window = 2.0 * math.pi / plant.rated_rotor_speed
    e2 = filtered("speed_error_integral", e1[0], between(e1), window)
    # The action before the record is not known; the first action of the record never meets a rate limit.
    last = torch.cat([actions[:1], actions])
    states = torch.cat([torch.stack([measured["rotor_speed"], omega_hat, u_hat, e2], -1), last], -1)
    if len(plant.states) == len(STATES):
        return states
    fast = filtered(FAST_SPEED.name, omega_g[0], between(omega_g), 1.0 / FAST_FILTER)
    return torch.cat([states, fast.unsqueeze(-1)], -1)


def started(
    plant: "WindTurbine", measured: Float[Tensor, "*batch 1"], exogenous: Float[Tensor, "*batch n_z"]
) -> Float[Tensor, "*batch n_c"]:
    """Settled filters, a torque by K ω_g² and blades at 0 deg, in the order of the states."""
    omega_g, wind = plant.gear_ratio * measured[..., 0], exogenous[..., 0]
    torque = (plant.optimal_gain * omega_g**2).clamp(max=plant.actions[0].high)
    fast = [omega_g] * (len(plant.states) - len(STATES))
    return torch.stack([omega_g, wind, plant.speed_error(omega_g, wind), torque, torch.zeros_like(wind), *fast], -1)
