"""What a real tank may have beside the plant: a pressure sensor that is off, and a slow valve."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from rt_torchrl.plants.actuators import LaggedActuator
from rt_torchrl.plants.neural_residual import NeuralResidual
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.sensors import BiasedSensor

if TYPE_CHECKING:
    from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank

VALVE_LAG = 600.0  # [s]; with which the identification begins
PRESSURE_ERROR = 10e3  # [Pa]; an error of 2 % of the set point counts as one
UNKNOWN_RATE = 0.2  # [Pa/s]; about the standard deviation of the pressure's rate under a moving valve


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


def further_suspects(plant: "CryogenicTank") -> Mapping[str, Plant]:
    """A rate of the pressure of unknown form that depends on pressure, liquid, valve and heat load."""
    (valve,) = plant.actions
    rate = NeuralResidual(
        plant,
        {"pressure": UNKNOWN_RATE},
        inputs=("pressure", "liquid_volume", valve.name, "heat_load"),
        ranges={"heat_load": (0.0, 400.0)},
    )
    return {"unknown heat": rate}
