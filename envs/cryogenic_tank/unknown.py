"""What a real tank may have beside its twin: systems by name, and what the plant suspects.

Parameters without a source are engineering guesses.
"""

from collections.abc import Mapping
from functools import partial

from rt_torchrl.plants.actuators import LaggedActuator
from rt_torchrl.plants.extension import Catalogue, System
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.sensors import BiasedSensor
from rt_torchrl.plants.vector_field import NeuralResidual

HOUR = 3600.0
EPISODE = 120.0 * HOUR
"""Time in which a drift reaches its size [s]."""
PRESSURE_ERROR = 10e3
"""Size of an offset of the sensor that counts as one [Pa], 2 % of the set point."""
FIRST_VALVE_LAG = 600.0
"""Time constant of the valve with which the identification begins [s]."""
UNKNOWN_RATE = 0.2
"""Size of an unknown rate [Pa/s]; about the standard deviation of the pressure's rate under a moving valve."""


def misread(plant: Plant, *, offset: float = 0.0, drift: float = 0.0) -> Plant:
    """A pressure sensor with an offset [Pa], and a drift that reaches its size [Pa] in 120 h.

    Offset and drift: engineering guesses, 1 to 5 % of the set point; data sheets of cryogenic transducers state 0.25 to
    1 % of the full scale, without thermal shift.
    """
    return BiasedSensor(plant, "pressure", offset, drift / EPISODE, scale=PRESSURE_ERROR)


def slow_valve(plant: Plant, lag: float = HOUR) -> Plant:
    """A valve whose drop or duty cycle changes slowly.

    Time constant 1 h: engineering guess, the lines behind the valve have to cool down first.
    """
    (valve,) = plant.actions
    return LaggedActuator(plant, valve.name, lag)


PARTS = ("valve", "pressure sensor")
"""Parts of the tank, in the order in which they are changed."""
SYSTEMS: Mapping[str, System] = {
    "bias_5": {"pressure sensor": partial(misread, offset=5e3)},
    "bias_15": {"pressure sensor": partial(misread, offset=15e3)},
    "bias_minus_15": {"pressure sensor": partial(misread, offset=-15e3)},
    "drift_10": {"pressure sensor": partial(misread, drift=10e3)},
    "drift_25": {"pressure sensor": partial(misread, drift=25e3)},
    "valve_lag": {"valve": slow_valve},
    "all": {"valve": slow_valve, "pressure sensor": partial(misread, offset=5e3)},
}
"""What the real tank has beside its twin, by the names of ``--unknown``."""


unknown = Catalogue(SYSTEMS, PARTS)
"""``unknown(plant, names)`` is the real tank that has all that the names say; its twin is ``plant``."""


def suspects(plant: Plant) -> Mapping[str, Plant]:
    """An offset and drift of the pressure sensor, a lag of the valve, and both."""
    return {
        "pressure sensor": misread(plant),
        "valve lags": slow_valve(plant, FIRST_VALVE_LAG),
        "pressure sensor, valve lags": slow_valve(misread(plant), FIRST_VALVE_LAG),
    }


def further_suspects(plant: Plant) -> Mapping[str, Plant]:
    """A rate of the pressure of unknown form that depends on pressure, liquid, valve and heat load."""
    (valve,) = plant.actions
    rate = NeuralResidual(
        plant,
        {"pressure": UNKNOWN_RATE},
        inputs=("pressure", "liquid_volume", valve.name, "heat_load"),
        ranges={"heat_load": (0.0, 400.0)},
    )
    return {"unknown heat": rate}
