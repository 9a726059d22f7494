"""What a real turbine has, or may have, beside the plant: unknown systems by name, suspects, and what they are made of.

Parameters without a source are engineering guesses.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Literal

import torch
from torch import nn

from rt_torchrl.plants.actuators import (
    DelayedActuator,
    LaggedActuator,
    PlayActuator,
    RateLimitedActuator,
    ResonantActuator,
    StickingActuator,
)
from rt_torchrl.plants.closures import FACTOR, PositiveCoefficients
from rt_torchrl.plants.extension import Catalogue, Extension, System, replaced
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Action, Hidden, Input, Inputs, Scalar, State, Time
from rt_torchrl.plants.signal import Signal
from rt_torchrl.plants.vector_field import NeuralResidual, ScaledCoefficients

PITCH_LAG = 0.7
"""Lag of the pitch drive with which an identification begins [s]."""
INFLOW_LAG = 6.0
"""Lag of the inflow with which an identification begins [s]; D/u at rated wind speed is 126 m/11.4 m/s = 11 s."""
UNKNOWN_ACCELERATION = 0.02
"""About a fifth of what the rated torque gives the rotor [rad/s²]."""
USUAL_POWER_COEFFICIENT = 0.4
MEGA = 1e6


class LaggedInflow(Extension):
    r"""A turbine whose rotor feels a torque τ, or takes a power P, that follows the quasi-steady one with a lag T.

    .. math:: T\dot\tau = \tau_a - \tau \quad\text{or}\quad T\dot P = \tau_a\omega_r - P,\; \tau = P/\omega_r, \qquad
        J\dot\omega_r = \tau - N_g\tau_g

    This is the crudest model of dynamic inflow: the wake takes the time D/u to change. The torque begins with the
    quasi-steady one of the true rotor, the power, which a twin identifies, with a usual C_p, both in the filtered wind.

    Args:
        base: the turbine.
        time_constant: T [s], positive, of the true system or with which the identification begins.
        of: what lags. The time constant of the torque is no coefficient of the closure.

    Raises:
        ValueError: if the base is an extension.
    """

    advance = Plant.advance

    def __init__(self, base: Plant, time_constant: float, of: Literal["torque", "power"] = "power"):
        if base.innermost is not base:
            raise ValueError(
                f"base={type(base).__name__} of LaggedInflow must be the turbine itself; extend the result."
            )
        if of == "torque":
            super().__init__(base, [Signal(symbol=r"\tau", name="lagged_torque", unit="N m")])
        else:
            meanings = {"force_lag": "time constant of the rotor's power"}
            closure = PositiveCoefficients([time_constant], names={"force_lag": "s"}, meanings=meanings, factor=FACTOR)
            super().__init__(base, [Signal(symbol="P", name="lagged_power", unit="MW")], closure.requires_grad_(False))
        self.of, self.time_constant = of, time_constant

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        plant: Any = self.base
        (base, hidden), inner, u = self.split(state), self.of_base(closure), exogenous[..., 0]
        # The floor is that of the torque, where the rotor hardly turns.
        speed = torch.maximum(base[..., 0], plant.least_tip_speed_ratio * u / plant.radius)
        torque = plant.aerodynamic_torque(base[..., 0], action[..., 1], u, inner)
        power = self.of == "power"
        missing = hidden[..., 0] * MEGA / speed - torque if power else hidden[..., 0] - torque
        field = plant.vector_field(t, base, action, exogenous, inner)
        accelerated = field[..., :1] + (missing / plant.inertia).unsqueeze(-1)
        if power:
            rate = -(missing * speed).unsqueeze(-1) / (MEGA * self.coefficients(closure)[0])
        else:
            rate = -missing.unsqueeze(-1) / self.time_constant
        return torch.cat([accelerated, field[..., 1:], rate], -1)

    def rest(self, base: State) -> Hidden:
        plant: Any = self.base
        speed, wind, pitch = base[..., 0], base[..., 2], base[..., 5]
        if self.of == "torque":
            return plant.aerodynamic_torque(speed, pitch, wind, plant.closure).unsqueeze(-1)
        power = 0.5 * plant.air_density * torch.pi * plant.radius**2 * USUAL_POWER_COEFFICIENT * wind**3
        return (power / MEGA).unsqueeze(-1)


class Blown(Extension):
    """A turbine in other wind, or with other torques, whose vector field is integrated.

    Args:
        base: the turbine, perhaps extended.
        hidden: signals of the hidden states.

    Raises:
        ValueError: if the turbine does not step by its vector field.
    """

    advance = Plant.advance

    def __init__(self, base: Plant, hidden: Sequence[Signal] = ()):
        if base.own_scheme:
            raise ValueError(
                f"{type(self).__name__} integrates the vector field; extend its result by actuators, not its base."
            )
        super().__init__(base, hidden)


class MisreadWind(Blown):
    r"""A turbine in a wind u of which the anemometer reads gu.

    The exogenous input of the extended plant is what the anemometer *reads*: records, previews and the filtered wind
    speed, which the controller computes, and with it the reference speed of the cost, hold the reading. The rotor turns
    in u.

    Args:
        base: the turbine, perhaps extended, whose state 2 is the filtered wind speed.
        gain: gain g of the anemometer, positive.

    Raises:
        ValueError: if the gain is not positive and finite, or the turbine does not step by its vector field.
    """

    def __init__(self, base: Plant, gain: float):
        if not 0.0 < gain < math.inf:
            raise ValueError(f"gain={gain} of the anemometer must be positive and finite.")
        super().__init__(base)
        turbine: Any = base.innermost
        self.gain, self.cutoff = gain, 2.0 * math.pi * turbine.filter_frequency

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        reading = exogenous[..., 0]
        true = reading / self.gain
        field = self.base.vector_field(t, state, action, replaced(exogenous, 0, true), closure)
        return replaced(field, 2, field[..., 2] + self.cutoff * (reading - true))

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> State:
        """The filtered wind speed starts at what the anemometer reads of the mean wind."""
        state = self.base.draw_initial_state(batch, generator)
        return replaced(state, 2, self.gain * state[..., 2])

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Inputs:
        """What the anemometer reads, which is never below its least reading, and the lidar with the same gain."""
        readings = self.gain * self.base.draw_exogenous(batch, generator)
        return readings.clamp(min=self.inputs[0].low)


class SwayingTower(Blown):
    r"""A turbine whose tower sways fore and aft, so that rotor and anemometer meet the wind u − v.

    .. math:: m\dot v = F(u - v, \beta) - 2\zeta m\Omega v - m\Omega^2x, \qquad \dot x = v, \qquad
        F = \tfrac12\rho A\,u^2 C_T(\beta)

    Mass m = 437 t (rotor and nacelle 350 t, a quarter of the tower), Ω = 2.04 rad/s and ζ = 1 % of the first fore-aft
    mode: NREL/TP-500-38060. Thrust :math:`C_T = 0.81 e^{-\beta/9\,\mathrm{deg}}`: a fit to the thrust curve there.

    Args:
        base: the turbine, perhaps extended.
        softness: share by which Ω is lower than that of the reference tower, in [0, 1).

    Raises:
        ValueError: if the softness is out of its range, or the turbine does not step by its vector field.
    """

    mass, natural_frequency, damping = 437e3, 2.04, 0.01
    thrust_coefficient, thrust_pitch = 0.81, 9.0

    def __init__(self, base: Plant, softness: float = 0.0):
        if not 0.0 <= softness < 1.0:
            raise ValueError(f"softness={softness} of the tower must lie in [0, 1).")
        place = Signal(symbol="x", name="tower_top", unit="m")
        super().__init__(base, [place, Signal(symbol="v", name="tower_top_speed", unit="m/s")])
        self.frequency = self.natural_frequency * (1.0 - softness)

    def thrust(self, wind: Scalar, pitch: Scalar) -> Scalar:
        """F [N] of the rotor in a wind [m/s] at a pitch [deg]."""
        turbine: Any = self.base.innermost
        coefficient = self.thrust_coefficient * torch.exp(-pitch / self.thrust_pitch)
        return 0.5 * turbine.air_density * math.pi * turbine.radius**2 * wind.square() * coefficient

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        (base, hidden), wind = self.split(state), exogenous[..., 0] - state[..., -1]
        x, v = hidden.unbind(-1)
        field = self.base.vector_field(t, base, action, replaced(exogenous, 0, wind), closure)
        spring = self.frequency**2 * x + 2.0 * self.damping * self.frequency * v
        return torch.cat([field, torch.stack([v, self.thrust(wind, action[..., 1]) / self.mass - spring], -1)], -1)

    def rest(self, base: State) -> Hidden:
        """The tower stands as the wind bends it on average, without motion."""
        x = self.thrust(base[..., 2], base[..., 5]) / (self.mass * self.frequency**2)
        return torch.stack([x, torch.zeros_like(x)], -1)


class LossySpeed(Blown):
    r"""A turbine whose drive train takes a share of the rated torque that grows with the square of the speed.

    .. math:: J\dot\omega_r = \ldots - \kappa\,N_g\tau_\mathrm{rated}\,(\omega_r/\omega_\mathrm{rated})^2

    Churning of oil and windage of the generator: engineering guess, gearboxes lose 3 to 6 %.

    Args:
        base: the turbine, perhaps extended.
        share: share κ of the rated torque at rated speed.

    Raises:
        ValueError: if the share is not positive and finite, or the turbine does not step by its vector field.
    """

    def __init__(self, base: Plant, share: float):
        if not 0.0 < share < math.inf:
            raise ValueError(f"share={share} of the rated torque must be positive and finite.")
        super().__init__(base)
        self.share = share

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        turbine: Any = self.base.innermost
        field = self.base.vector_field(t, state, action, exogenous, closure)
        rated = turbine.rated_rotor_speed
        loss = self.share * turbine.gear_ratio * turbine.actions[0].high * (state[..., 0] / rated) ** 2
        return replaced(field, 0, field[..., 0] - loss / turbine.inertia)


def suspects(plant: Plant) -> Mapping[str, Plant]:
    """What a twin of the turbine suspects: dead times of one to three intervals and a lag of the pitch, and inflow."""

    def late(base: Plant, intervals: int) -> Plant:
        return DelayedActuator(base, "blade_pitch", intervals * plant.dt)

    def lagging(base: Plant) -> Plant:
        return LaggedActuator(base, "blade_pitch", PITCH_LAG)

    return {
        "pitch lag": lagging(plant),
        "pitch late by 1": late(plant, 1),
        "pitch late by 3": late(plant, 3),
        "pitch lag, late by 1": late(lagging(plant), 1),
        "pitch lag, late by 3": late(lagging(plant), 3),
        "inflow": LaggedInflow(plant, INFLOW_LAG),
        "inflow, pitch lag, late by 2": late(lagging(LaggedInflow(plant, INFLOW_LAG)), 2),
    }


def further_suspects(plant: Plant) -> Mapping[str, Plant]:
    """What a twin suspects by name only: a torque that depends in an unknown way on rotor speed, pitch and wind."""
    torque = NeuralResidual(
        plant,
        {"rotor_speed": UNKNOWN_ACCELERATION},
        inputs=("rotor_speed", "blade_pitch", "wind_speed"),
        ranges={"rotor_speed": (0.0, 1.6), "wind_speed": (3.0, 25.0)},
    )
    return {"unknown torque": torque}


def slow_pitch(plant: Plant) -> Plant:
    """A weak pitch drive of second order (1.5 rad/s, damping 0.7) behind a slow link (1 s); engineering guesses."""
    return DelayedActuator(ResonantActuator(plant, "blade_pitch", 1.5, 0.7), "blade_pitch", 1.0)


PARTS = ("inflow", "shaft", "tower", "anemometer", "pitch drive")
"""Parts of the turbine, in the order in which they are changed: what is next to the rotor comes first."""
SYSTEMS: dict[str, System] = {
    # Engineering guesses; anemometers on a nacelle stand in the wake of the blades.
    "anemometer_low": {"anemometer": partial(MisreadWind, gain=0.9)},
    "anemometer_high": {"anemometer": partial(MisreadWind, gain=1.1)},
    # Losses in bearings and gears; engineering guess: NREL/TP-500-38060 has none there, and 5.6 % in the generator.
    "torque_loss": {"shaft": partial(ScaledCoefficients, gain=0.92)},
    # D/u at rated wind speed, 126 m/11.4 m/s = 11 s, rounded; D and u of NREL/TP-500-38060.
    "inflow": {"inflow": partial(LaggedInflow, time_constant=10.0, of="torque")},
    "pitch": {"pitch drive": slow_pitch},
    # Pitch drives of 5-MW turbines reach 8 deg/s (NREL/TP-500-38060); 2 and 1 deg/s: engineering guesses, worn drives.
    "pitch_rate_2": {"pitch drive": partial(RateLimitedActuator, action="blade_pitch", size=2.0)},
    "pitch_rate_1": {"pitch drive": partial(RateLimitedActuator, action="blade_pitch", size=1.0)},
    # Play and stiction of worn gears and bearings; engineering guesses.
    "pitch_play": {"pitch drive": partial(PlayActuator, action="blade_pitch", size=2.5)},
    "pitch_sticks": {"pitch drive": partial(StickingActuator, action="blade_pitch", size=2.0)},
    "tower": {"tower": SwayingTower},
    "tower_soft": {"tower": partial(SwayingTower, softness=0.4)},
    "speed_loss": {"shaft": partial(LossySpeed, share=0.1)},
}
"""What the real turbine has beside its twin, by the names of ``--unknown``."""
SYSTEMS["all"] = {**SYSTEMS["inflow"], **SYSTEMS["torque_loss"], **SYSTEMS["anemometer_low"], **SYSTEMS["pitch"]}

unknown = Catalogue(SYSTEMS, PARTS)
"""``unknown(plant, names)`` is the real turbine that has all that the names say; its twin is ``plant``."""
