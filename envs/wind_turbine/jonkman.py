"""The classical controller of the NREL 5-MW turbine, which learned policies are compared with."""

import json
import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.envs.wind_turbine.plant import WindTurbine

CONSTANTS = Path(__file__).parent / "data" / "nrel5mw_constants.json"


class JonkmanController(ClassicalController):
    r"""Torque by regions of the generator speed, and pitch by a gain-scheduled PI law.

    .. math::
        \tau_g = \begin{cases}0 & \text{1}\\ \text{linear} & 1\tfrac12\\ K\omega_F^2 & 2\\ \text{linear} & 2\tfrac12\\
        P_r/\omega_F & 3\end{cases}, \qquad
        \beta = \frac{K_P(\omega_F - \omega_r) + K_I\int(\omega_F - \omega_r)\,dt}{1 + \beta/\beta_K}

    with the low-passed generator speed ω_F. The memory holds ω_F and the integral. The constants are published, so that
    there are no gains to tune.

    Args:
        plant: the turbine; its actuators limit the rates.
        compiled: whether flights are compiled.

    Source: Jonkman et al., NREL/TP-500-38060, section 7; the variables are those of ``DISCON.F90``.
    """

    plant: WindTurbine
    memory_size = 2

    def __init__(self, plant: WindTurbine, *, compiled: bool = False):
        super().__init__(plant, compiled=compiled)
        c = json.loads(CONSTANTS.read_text(encoding="utf-8"))["jonkman_controller"]
        self.c = c
        self.alpha = math.exp(-plant.dt * c["CornerFreq_rad_s"])
        self.slope_15 = c["VS_Rgn2K"] * c["VS_Rgn2Sp"] ** 2 / (c["VS_Rgn2Sp"] - c["VS_CtInSp"])
        self.synchronous = c["VS_RtGnSp"] / (1.0 + 0.01 * c["VS_SlPc"])
        self.slope_25 = c["VS_RtPwr"] / c["VS_RtGnSp"] / (c["VS_RtGnSp"] - self.synchronous)
        root = math.sqrt(self.slope_25 * (self.slope_25 - 4.0 * c["VS_Rgn2K"] * self.synchronous))
        self.transition = (self.slope_25 - root) / (2.0 * c["VS_Rgn2K"])

    def first_memory(self, state: Float[Tensor, "batch n_s"]) -> Float[Tensor, "batch 2"]:
        """The memory at the start: the present speed, and the integral that keeps the present pitch."""
        pitch = torch.deg2rad(state[:, 5])
        integral = pitch * (1.0 + pitch / self.c["PC_KK_rad"]) / self.c["PC_KI"]
        return torch.stack([self.plant.gear_ratio * state[:, 0], integral], -1)

    def law(
        self, state: Float[Tensor, "batch n_s"], memory: Float[Tensor, "batch 2"]
    ) -> tuple[Float[Tensor, "batch 2"], Float[Tensor, "batch 2"]]:
        speed, integral = memory.unbind(-1)
        pitch = torch.deg2rad(state[:, 5])
        speed = (1.0 - self.alpha) * self.plant.gear_ratio * state[:, 0] + self.alpha * speed
        torque = self.torque(speed, pitch)
        pitch, integral = self.pitch(speed, pitch, integral)
        return torch.stack([torque, torch.rad2deg(pitch)], -1), torch.stack([speed, integral], -1)

    def torque(self, speed: Float[Tensor, " batch"], pitch: Float[Tensor, " batch"]) -> Float[Tensor, " batch"]:
        """Generator torque [N m] at a filtered speed [rad/s]; region 3 also while the blades are pitched [rad]."""
        c = self.c
        torque = torch.where(
            speed < self.transition, c["VS_Rgn2K"] * speed**2, self.slope_25 * (speed - self.synchronous)
        )
        torque = torch.where(speed < c["VS_Rgn2Sp"], self.slope_15 * (speed - c["VS_CtInSp"]), torque)
        torque = torch.where(speed <= c["VS_CtInSp"], 0.0, torque)
        rated = (speed >= c["VS_RtGnSp"]) | (pitch >= c["VS_Rgn3MP_rad"])
        torque = torch.where(rated, c["VS_RtPwr"] / speed, torque)
        return torque.clamp(self.plant.actions[0].low, self.plant.actions[0].high)

    def pitch(self, speed: Tensor, pitch: Tensor, integral: Tensor) -> tuple[Tensor, Tensor]:
        """Pitch command [rad] and the new integral of the speed error [rad], which saturates with the pitch."""
        c = self.c
        gain = 1.0 / (1.0 + pitch / c["PC_KK_rad"])
        error = speed - c["PC_RefSpd"]
        highest = math.radians(self.plant.actions[1].high)
        integral = integral + error * self.plant.dt
        integral = integral.clamp(min=c["PC_MinPit"]).minimum(highest / (gain * c["PC_KI"]))
        command = gain * (c["PC_KP_s"] * error + c["PC_KI"] * integral)
        return command.clamp(c["PC_MinPit"], highest), integral
