"""Controllers of the turbine as wind engineers build them: Jonkman's, and one whose gains are trained."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.envs.wind_turbine.plant import FAST_FILTER, RATED_GENERATOR_SPEED, WindTurbine
from rt_torchrl.plants.shapes import Action, Costs, Input, Memory, State
from rt_torchrl.plants.signal import bounds


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

    Source: Jonkman et al., NREL/TP-500-38060, section 7. Comments name the variables of NREL's ``DISCON.F90``.
    """

    plant: WindTurbine
    memory_size = 2

    proportional_gain = 0.01882681  # K_P [s], PC_KP
    integral_gain = 0.008068634  # K_I [-], PC_KI
    schedule_pitch = 0.1099965  # β_K, at which the pitch acts on the power twice as much [rad], PC_KK
    reference_speed = RATED_GENERATOR_SPEED  # ω_r [rad/s], PC_RefSpd
    cut_in_speed = 70.16224  # end of region 1 [rad/s], VS_CtInSp
    square_speed = 91.21091  # end of region 1½ [rad/s], VS_Rgn2Sp
    torque_gain = 2.332287  # K [N m s²/rad²], VS_Rgn2K
    constant_power_speed = 121.6805  # end of region 2½ [rad/s], VS_RtGnSp
    slip = 10.0  # of region 2½ [%], VS_SlPc
    power = 5_296_610.0  # P_r at the shaft [W], VS_RtPwr
    constant_power_pitch = 0.01745329  # pitch from which region 3 holds at any speed [rad], VS_Rgn3MP

    def __init__(self, plant: WindTurbine):
        super().__init__(plant)
        self.alpha = math.exp(-plant.dt * FAST_FILTER)
        self.cut_in_slope = self.torque_gain * self.square_speed**2 / (self.square_speed - self.cut_in_speed)
        self.synchronous_speed = self.constant_power_speed / (1.0 + 0.01 * self.slip)
        torque = self.power / self.constant_power_speed
        self.slip_slope = torque / (self.constant_power_speed - self.synchronous_speed)
        # Where the square law meets the line of region 2½.
        root = math.sqrt(self.slip_slope * (self.slip_slope - 4.0 * self.torque_gain * self.synchronous_speed))
        self.slip_speed = (self.slip_slope - root) / (2.0 * self.torque_gain)

    def first_memory(self, state: State) -> Memory:
        """The memory at the start: the present speed, and the integral that keeps the present pitch."""
        pitch = torch.deg2rad(state[:, 5])
        integral = pitch * (1.0 + pitch / self.schedule_pitch) / self.integral_gain
        return torch.stack([self.plant.gear_ratio * state[:, 0], integral], -1)

    def law(self, state: State, memory: Memory, exogenous: Input) -> tuple[Action, Memory]:
        speed, integral = memory.unbind(-1)
        pitch = torch.deg2rad(state[:, 5])
        speed = (1.0 - self.alpha) * self.plant.gear_ratio * state[:, 0] + self.alpha * speed
        torque = self.torque(speed, pitch)
        pitch, integral = self.pitch(speed, pitch, integral)
        return torch.stack([torque, torch.rad2deg(pitch)], -1), torch.stack([speed, integral], -1)

    def torque(self, speed: Costs, pitch: Costs) -> Costs:
        """Generator torque [N m] at a filtered speed [rad/s]; region 3 also while the blades are pitched [rad]."""
        line = self.slip_slope * (speed - self.synchronous_speed)
        torque = torch.where(speed < self.slip_speed, self.torque_gain * speed**2, line)
        torque = torch.where(speed < self.square_speed, self.cut_in_slope * (speed - self.cut_in_speed), torque)
        torque = torch.where(speed <= self.cut_in_speed, 0.0, torque)
        rated = (speed >= self.constant_power_speed) | (pitch >= self.constant_power_pitch)
        torque = torch.where(rated, self.power / speed, torque)
        return torque.clamp(self.plant.actions[0].low, self.plant.actions[0].high)

    def pitch(self, speed: Tensor, pitch: Tensor, integral: Tensor) -> tuple[Tensor, Tensor]:
        """Pitch command [rad] and the new integral of the speed error [rad], which saturates with the pitch."""
        gain = 1.0 / (1.0 + pitch / self.schedule_pitch)
        error = speed - self.reference_speed
        lowest, highest = (math.radians(end) for end in (self.plant.actions[1].low, self.plant.actions[1].high))
        integral = integral + error * self.plant.dt
        integral = integral.clamp(min=lowest).minimum(highest / (gain * self.integral_gain))
        command = gain * (self.proportional_gain * error + self.integral_gain * integral)
        return command.clamp(lowest, highest), integral


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
        generator: source of the first gains, 1/2 to 2 times the nominal ones.

    Raises:
        ValueError: if the plant does not observe the signals.

    Source: the regions and constants of Jonkman et al., NREL/TP-500-38060, section 7.
    """

    SEES = ("speed_above_rated", "speed_rate", "blade_pitch")
    NOMINAL = {
        "torque_gain": JonkmanController.torque_gain,  # K [N m s²/rad²]
        "proportional": math.degrees(JonkmanController.proportional_gain),  # K_P [deg s/rad]
        "integral": math.degrees(JonkmanController.integral_gain),  # K_I [deg/rad]
        "schedule": math.degrees(JonkmanController.schedule_pitch),  # β_K [deg]
    }

    reference_speed = 124.5  # ω_ref of the pitch law [rad/s]
    switch_speed = 118.5  # ω_s, at which the torque leaves region 2 [rad/s]
    switch_width = 1.0  # w_s of that transition [rad/s], about that of Jonkman's table
    switch_pitch = 1.0  # c, which keeps region 3 while the blades are pitched [rad/s per deg]

    def __init__(self, plant: WindTurbine, *, generator: torch.Generator):
        super().__init__()
        names = [signal.name for signal in plant.observations]
        if not set(self.SEES) <= set(names):
            raise ValueError(
                f"the gain-scheduled law sees {', '.join(self.SEES)}, but the plant observes {', '.join(names)}; make "
                'the turbine with observe=("scheduled",).'
            )
        self._places = [names.index(name) for name in self.SEES]
        self._names = tuple(self.NOMINAL)
        share = torch.rand(len(self.NOMINAL), generator=generator, dtype=torch.float64, device=generator.device)
        self.weights = nn.Parameter(math.log(2.0) * (2.0 * share - 1.0))
        self.nominal = nn.Buffer(torch.tensor(list(self.NOMINAL.values()), dtype=torch.float64))
        self.low, self.high = map(nn.Buffer, bounds(plant.actions))
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
