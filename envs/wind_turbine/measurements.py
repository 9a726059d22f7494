r"""The signals of the wind turbine, and what its sensors give.

The instruments of a classical controller are the rotor speed, its rate and the pitch of the blades. A policy has no
memory, so that the plant holds that of a PI law: the pitch that was applied last is its integral, and a faster low-pass
of the generator speed with Jonkman's corner frequency ω_c = 0.25 Hz gives the rate,

.. math:: \dot\omega_F = \omega_c(\omega_g - \omega_F)

A lidar gives the wind that the rotor will meet in 2, 4 and 8 s.
"""

from typing import TYPE_CHECKING

from torch import Tensor

from rt_torchrl.plants.signal import Measurement, Named, Preview, Signal

if TYPE_CHECKING:
    from rt_torchrl.envs.wind_turbine.plant import WindTurbine

STATES = (
    Signal(symbol=r"\omega_r", name="rotor_speed", unit="rad/s", low=0.0),
    Signal(symbol=r"\hat\omega_g", name="filtered_generator_speed", unit="rad/s"),
    Signal(symbol=r"\hat u", name="filtered_wind_speed", unit="m/s"),
    Signal(symbol="e_2", name="speed_error_integral", unit="-"),
    Signal(symbol=r"\tau_g", name="generator_torque", unit="N m", low=0.0, high=43_093.55),
    Signal(symbol=r"\beta", name="blade_pitch", unit="deg", low=0.0, high=30.0),
)
FAST_SPEED = Signal(symbol=r"\omega_F", name="fast_generator_speed", unit="rad/s")
"""State that a turbine has if one of ``OF_FAST_SPEED`` is observed."""
FAST_FILTER = 1.570796
"""ω_c [rad/s], CornerFreq of the reference controller."""
INPUTS = (Signal(symbol="u", name="wind_speed", unit="m/s", low=3.0),)
LEADS = (2.0, 4.0, 8.0)
"""Times ahead [s] at which a lidar measures the wind."""

RATED_SPEED, SPEED_SCALE = 122.9096, 20.0
"""Rated generator speed and γ1 [rad/s]."""
WIND_AT_REST, WIND_SCALE = 11.0, 3.0
"""Wind speed that is observed as zero, and change that is observed as one [m/s]."""


def speed_error(plant: "WindTurbine", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The error e_1 of the filtered generator speed."""
    return plant.speed_error(state[..., 1], state[..., 2])


def speed_rate(plant: "WindTurbine", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The difference ω_g − ω_F [rad/s], which is the rate of ω_F over ω_c."""
    return plant.gear_ratio * state[..., 0] - state[..., 6]


def _of_state(index: int, *, offset: float = 0.0, scale: float = 1.0) -> Measurement:
    return Measurement.of(STATES[index], offset=offset, scale=scale)


def _ahead(lead: float) -> Measurement:
    wind = Signal(symbol=rf"u_{{+{lead:g}}}", name=f"wind_speed_in_{lead:g}_s", unit="m/s", low=3.0)
    return Measurement.of(wind, Preview(0, lead), offset=WIND_AT_REST, scale=WIND_SCALE)


OF_FAST_SPEED = (
    Measurement(
        symbol=r"e_\omega",
        name="speed_above_rated",
        unit="rad/s",
        low=RATED_SPEED - 2.0 * SPEED_SCALE,
        high=RATED_SPEED + SPEED_SCALE,
        read=Named(FAST_SPEED.name),
        offset=RATED_SPEED,
        scale=SPEED_SCALE,
    ),
    Measurement(
        symbol=r"e_{\dot\omega}",
        name="speed_rate",
        unit="rad/s",
        low=-0.2 * SPEED_SCALE,
        high=0.2 * SPEED_SCALE,
        read=speed_rate,
        scale=SPEED_SCALE,
    ),
)
MEASUREMENTS = (
    Measurement(symbol="e_1", name="speed_error", unit="-", low=-1.0, high=1.0, read=speed_error),
    Measurement(symbol="e_2", name="speed_error_integral", unit="-", low=-1.0, high=1.0, read=Named(STATES[3].name)),
    _of_state(0, offset=1.26711, scale=0.2),
    _of_state(1, offset=RATED_SPEED, scale=SPEED_SCALE),
    _of_state(2, offset=WIND_AT_REST, scale=WIND_SCALE),
    _of_state(4, offset=21_546.775, scale=21_546.775),
    _of_state(5, scale=30.0),
    *OF_FAST_SPEED,
    Measurement.of(INPUTS[0], offset=WIND_AT_REST, scale=WIND_SCALE),
    *map(_ahead, LEADS),
)
ERRORS = ("speed_error", "speed_error_integral")
MEASURED = (
    *ERRORS,
    *("rotor_speed", "filtered_generator_speed", "filtered_wind_speed", "generator_torque", "blade_pitch"),
)
OBSERVATION_SETS = {
    "paper": ERRORS,
    "errors": (*ERRORS, "rotor_speed"),
    "scheduled": (*ERRORS, "speed_above_rated", "speed_rate", "blade_pitch"),
    "measured": MEASURED,
    "measured+wind": (*MEASURED, "wind_speed"),
    "preview": (*MEASURED, "wind_speed", *(f"wind_speed_in_{lead:g}_s" for lead in LEADS)),
}
"""Names of measurements: the paper's errors; these with the rotor speed; the instruments of a gain-scheduled law; all
states; all states with the wind; and these with the lidar's preview."""
