"""What a real tank may have beside the plant: a pressure sensor that is off, and a slow valve."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from rt_torchrl.plants.extensions.biased_sensor import BiasedSensor
from rt_torchrl.plants.extensions.lagged_actuator import LaggedActuator
from rt_torchrl.plants.plant import Plant

if TYPE_CHECKING:
    from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank

VALVE_LAG = 600.0  # [s]; with which the identification begins
PRESSURE_ERROR = 10e3  # [Pa]; an error of 2 % of the set point counts as one


def suspects(plant: "CryogenicTank") -> Mapping[str, Plant]:
    """An offset and drift of the pressure sensor, a lag of the valve, and both."""
    (valve,) = plant.actions

    def biased(base: Plant) -> Plant:
        return BiasedSensor(base, "pressure", 0.0, scale=PRESSURE_ERROR)

    def lagging(base: Plant) -> Plant:
        return LaggedActuator(base, valve.name, VALVE_LAG)

    return {
        "pressure sensor": biased(plant),
        "valve lags": lagging(plant),
        "pressure sensor, valve lags": lagging(biased(plant)),
    }
