"""What a real turbine may have beside the plant: dynamics of the pitch drive and of the inflow."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from rt_torchrl.plants.actuators import DelayedActuator, LaggedActuator
from rt_torchrl.plants.neural_residual import NeuralResidual
from rt_torchrl.plants.plant import Plant

if TYPE_CHECKING:
    from rt_torchrl.envs.wind_turbine.plant import WindTurbine

PITCH_LAG = 0.7  # [s]; guess with which the identification begins
INFLOW_LAG = 6.0  # [s]; about D/u at rated wind speed, 126 m/11.4 m/s = 11 s, within a factor of two
UNKNOWN_ACCELERATION = 0.02  # [rad/s²]; about a fifth of what the rated torque gives the rotor


def suspects(plant: "WindTurbine") -> Mapping[str, Plant]:
    """Dead times of one to three control intervals and a lag of the pitch drive, and a lagging inflow."""

    def late(base: Plant, intervals: int) -> Plant:
        return DelayedActuator(base, "blade_pitch", intervals * plant.dt)

    def lagging(base: Plant) -> Plant:
        return LaggedActuator(base, "blade_pitch", PITCH_LAG)

    def inflow() -> Plant:
        from rt_torchrl.envs.wind_turbine.lagged_power import LaggedPower  # here, because it extends the plant

        return LaggedPower(plant, INFLOW_LAG)

    return {
        "pitch lag": lagging(plant),
        "pitch late by 1": late(plant, 1),
        "pitch late by 3": late(plant, 3),
        "pitch lag, late by 1": late(lagging(plant), 1),
        "pitch lag, late by 3": late(lagging(plant), 3),
        "inflow": inflow(),
        "inflow, pitch lag, late by 2": late(lagging(inflow()), 2),
    }


def further_suspects(plant: "WindTurbine") -> Mapping[str, Plant]:
    """A torque of unknown form that depends on the speed of the rotor, the pitch and the wind."""
    torque = NeuralResidual(
        plant,
        {"rotor_speed": UNKNOWN_ACCELERATION},
        inputs=("rotor_speed", "blade_pitch", "wind_speed"),
        ranges={"rotor_speed": (0.0, 1.6), "wind_speed": (3.0, 25.0)},
    )
    return {"unknown torque": torque}
