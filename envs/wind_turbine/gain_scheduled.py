r"""A turbine controller as wind engineers build it, with gains that are trained."""

import math
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.wind_turbine.measurements import FAST_FILTER
from rt_torchrl.plants.signal import bounds

if TYPE_CHECKING:
    from rt_torchrl.envs.wind_turbine.plant import WindTurbine

SEES = ("speed_above_rated", "speed_rate", "blade_pitch")


class GainScheduled(nn.Module):
    r"""Torque :math:`K\omega^2` below rated speed and at constant power above it, and pitch by a gain-scheduled PI law.

    .. math::
        \tau_g = (1 - s)\,K\omega_F^2 + s\,P_r/\omega_F, \qquad
        s = \sigma\big((\omega_F - \omega_s + c\,\beta)/w_s\big), \\
        \beta^+ = \beta + \Delta t\,\frac{K_P\,\dot\omega_F + K_I(\omega_F - \omega_{ref})}{1 + \beta/\beta_K}

    The last line is the PI law in its increments. The pitch that was applied last is its integral, which thus winds up
    no further than the blades turn. The logistic function σ blends the regions where Jonkman's table switches. Both
    commands are clamped to the ranges of the actions.

    The weights are the logarithms of K, K_P, K_I and β_K over their values in ``NOMINAL``, those of Jonkman's
    controller. The set-points are no weights: the reference power K ω_g³ of the turbine's J_a is a fifth below the
    power of the drivetrain at rated speed, and a set-point that follows J_a would throw that power away. This law holds
    the speed tighter than Jonkman's. So that it spills no wind, ω_s is a little below his 120 rad/s and ω_ref 1.3 %
    above rated speed.

    Args:
        plant: a turbine whose policies observe speed above rated, speed rate and pitch, as by
            ``observe=("scheduled",)``; other observations are ignored. It gives scales, ranges and control interval.
        detuning: width of the draw of the first gains, exp(U(−detuning, detuning)) times the nominal gains.
        reference_speed: reference speed ω_ref of the pitch law [rad/s].
        switch_speed: speed ω_s at which the torque leaves region 2 [rad/s].
        switch_width: width w_s of that transition [rad/s].
        switch_pitch: factor c, which keeps region 3 while the blades are pitched [rad/s per deg].
        generator: source of the detuning.

    Raises:
        ValueError: if the detuning is negative, the width of the transition is not positive, or the plant does not
            observe the signals.

    Source: the regions and constants of Jonkman et al., NREL/TP-500-38060, section 7.
    """

    NOMINAL = {
        "torque_gain": 2.332287,  # K [N m s²/rad²]
        "proportional": math.degrees(0.01882681),  # K_P [deg s/rad]
        "integral": math.degrees(0.008068634),  # K_I [deg/rad]
        "schedule": math.degrees(0.1099965),  # β_K [deg]
    }

    nominal: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self,
        plant: "WindTurbine",
        *,
        detuning: float = math.log(2.0),
        reference_speed: float = 124.5,
        switch_speed: float = 118.5,
        switch_width: float = 1.0,
        switch_pitch: float = 1.0,
        generator: torch.Generator,
    ):
        super().__init__()
        if not detuning >= 0.0:
            raise ValueError(f"detuning={detuning} of the gains must not be negative.")
        if not switch_width > 0.0:
            raise ValueError(f"switch_width={switch_width} rad/s must be positive; Jonkman's table takes about 1.")
        names = [signal.name for signal in plant.observations]
        if not set(SEES) <= set(names):
            raise ValueError(
                f"the gain-scheduled law sees {', '.join(SEES)}, but the plant observes {', '.join(names)}; make the "
                'turbine with observe=("scheduled",).'
            )
        self._places = [names.index(name) for name in SEES]
        self._names = tuple(self.NOMINAL)
        share = torch.rand(len(self.NOMINAL), generator=generator, dtype=torch.float64, device=generator.device)
        self.weights = nn.Parameter(detuning * (2.0 * share - 1.0))
        self.register_buffer("nominal", torch.tensor(list(self.NOMINAL.values()), dtype=torch.float64))
        low, high = bounds(plant.actions)
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.reference_speed, self.switch_speed = reference_speed, switch_speed
        self.switch_width, self.switch_pitch = switch_width, switch_pitch
        self.dt = plant.dt
        self.rated_speed, self.speed_scale = plant.rated_generator_speed, plant.speed_error_scale
        self.power = plant.actions[0].high * plant.rated_generator_speed

    def gains(self) -> dict[str, Tensor]:
        """The gains by name, in the units of ``NOMINAL``."""
        return dict(zip(self._names, (self.nominal * torch.exp(self.weights)).unbind(), strict=True))

    def forward(self, observation: Float[Tensor, "*batch n_o"]) -> Float[Tensor, "*batch 2"]:
        above, rate, pitch = (observation[..., place] for place in self._places)
        omega, beta = self.rated_speed + self.speed_scale * above, pitch * self.high[1]
        g = self.gains()
        share = torch.sigmoid((omega - self.switch_speed + self.switch_pitch * beta) / self.switch_width)
        # At standstill no torque gives constant power; region 3 does not reach there.
        region_3 = self.power / torch.where(omega > 0.5 * self.rated_speed, omega, 0.5 * self.rated_speed)
        torque = (1.0 - share) * g["torque_gain"] * omega**2 + share * region_3
        push = g["proportional"] * FAST_FILTER * self.speed_scale * rate
        push = push + g["integral"] * (omega - self.reference_speed)
        command = beta + self.dt * push / (1.0 + beta / g["schedule"])
        return torch.stack([torque, command], -1).clamp(self.low, self.high)
