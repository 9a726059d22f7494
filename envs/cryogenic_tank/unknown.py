"""Real tanks that their twin does not know, by name; parameters without a source are engineering guesses."""

from collections.abc import Mapping, Sequence
from functools import partial

from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.cryogenic_tank.two_zones import TwoZones
from rt_torchrl.plants.actuators import LaggedActuator
from rt_torchrl.plants.extension import System, combined, require_systems
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.sensors import BiasedSensor

HOUR = 3600.0
EPISODE = 120.0 * HOUR
"""Time in which a drift reaches its size [s]."""
SCALE = 10e3
"""Size of an offset that counts as one [Pa], 2 % of the set point."""


def misread(plant: Plant, *, offset: float = 0.0, drift: float = 0.0) -> Plant:
    """A pressure sensor with an offset [Pa], and a drift that reaches its size [Pa] in 120 h.

    Offset and drift: engineering guesses, 1 to 5 % of the set point; data sheets of cryogenic transducers state 0.25 to
    1 % of the full scale, without thermal shift.
    """
    return BiasedSensor(plant, "pressure", offset, drift / EPISODE, scale=SCALE)


def slow_valve(plant: Plant) -> Plant:
    """A valve whose duty cycle changes slowly.

    Time constant 1 h: engineering guess, the lines behind the valve have to cool down first.
    """
    (valve,) = plant.actions
    return LaggedActuator(plant, valve.name, HOUR)


def two_zones(plant: Plant) -> Plant:
    """A tank that nobody stirs.

    Ratio 2: engineering guess; tanks on the ground rise up to a few times as fast as the stirred model. Mixing time
    5 h: engineering guess, a pump that turns the liquid over a few times a day.
    """
    return TwoZones(plant, 2.0, 5.0 * HOUR)


PARTS = ("mixture", "valve", "pressure sensor")
"""Parts of the tank, in the order in which they are changed."""
SYSTEMS: Mapping[str, System] = {
    "bias_5": {"pressure sensor": partial(misread, offset=5e3)},
    "bias_15": {"pressure sensor": partial(misread, offset=15e3)},
    "bias_minus_15": {"pressure sensor": partial(misread, offset=-15e3)},
    "drift_10": {"pressure sensor": partial(misread, drift=10e3)},
    "drift_25": {"pressure sensor": partial(misread, drift=25e3)},
    "valve_lag": {"valve": slow_valve},
    "two_zones": {"mixture": two_zones},
    "all": {"mixture": two_zones, "valve": slow_valve, "pressure sensor": partial(misread, offset=5e3)},
}
"""What the real tank has beside its twin, by the names of ``--unknown``."""


def require_unknown(names: Sequence[str]) -> None:
    """Refuse names that do not exist, or change the same part.

    Raises:
        ValueError: if there are such names.
    """
    require_systems(names, SYSTEMS)


def unknown(plant: CryogenicTank, names: Sequence[str]) -> Plant:
    """The real tank that has all that the names say; its twin is ``plant``.

    Raises:
        ValueError: if a name does not exist, or two of them change the same part.
    """
    return combined(plant, names, SYSTEMS, PARTS)
