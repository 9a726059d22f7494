"""Real turbines that their twin does not know, by name; parameters without a source are engineering guesses."""

import math
from collections.abc import Mapping, Sequence

from rt_torchrl.envs.wind_turbine.lagged_torque import LaggedTorque
from rt_torchrl.envs.wind_turbine.misread_wind import MisreadWind
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.plants.actuators import DelayedActuator, ResonantActuator
from rt_torchrl.plants.coefficients import ScaledCoefficients
from rt_torchrl.plants.extension import System, combined, require_systems
from rt_torchrl.plants.plant import Plant


def low_anemometer(plant: Plant) -> Plant:
    """An anemometer that reads 10 % too little.

    Gain 0.9: engineering guess; anemometers on a nacelle stand in the wake of the blades.
    """
    return MisreadWind(plant, 0.9, cutoff=2.0 * math.pi * WindTurbine.filter_frequency)


def high_anemometer(plant: Plant) -> Plant:
    """An anemometer that reads 10 % too much.

    Gain 1.1: engineering guess.
    """
    return MisreadWind(plant, 1.1, cutoff=2.0 * math.pi * WindTurbine.filter_frequency)


def torque_loss(plant: Plant) -> Plant:
    """A shaft whose bearings and gears lose some of the rotor's torque.

    Loss 8 %: engineering guess; NREL/TP-500-38060 has none in the gearbox, and 5.6 % in the generator.
    """
    return ScaledCoefficients(plant, 0.92)


def inflow(plant: WindTurbine) -> Plant:
    """A wake that takes its time.

    Time constant 10 s: D/u at rated wind speed, 126 m/11.4 m/s = 11 s, rounded; D and u of NREL/TP-500-38060.
    """
    return LaggedTorque(plant, 10.0)


def slow_pitch(plant: Plant) -> Plant:
    """A pitch drive of second order behind a slow link.

    Frequency 1.5 rad/s: engineering guess, a weak drive. Damping 0.7: engineering guess, the usual tuning of a drive.
    Dead time 1 s: engineering guess, a link and a valve of a hydraulic drive.
    """
    return DelayedActuator(ResonantActuator(plant, "blade_pitch", 1.5, 0.7), "blade_pitch", 1.0)


PARTS = ("inflow", "shaft", "anemometer", "pitch drive")
"""Parts of the turbine, in the order in which they are changed: what is next to the rotor comes first."""
SYSTEMS: Mapping[str, System] = {
    "anemometer_low": {"anemometer": low_anemometer},
    "anemometer_high": {"anemometer": high_anemometer},
    "torque_loss": {"shaft": torque_loss},
    "inflow": {"inflow": inflow},
    "pitch": {"pitch drive": slow_pitch},
    "all": {
        "inflow": inflow,
        "shaft": torque_loss,
        "anemometer": low_anemometer,
        "pitch drive": slow_pitch,
    },
}
"""What the real turbine has beside its twin, by the names of ``--unknown``."""


def require_unknown(names: Sequence[str]) -> None:
    """Refuse names that do not exist, or change the same part.

    Raises:
        ValueError: if there are such names.
    """
    require_systems(names, SYSTEMS)


def unknown(plant: WindTurbine, names: Sequence[str]) -> Plant:
    """The real turbine that has all that the names say; its twin is ``plant``.

    Raises:
        ValueError: if a name does not exist, or two of them change the same part.
    """
    return combined(plant, names, SYSTEMS, PARTS)
