"""What a real drone may have beside the plant: dynamics of its two actuators."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from rt_torchrl.plants.actuators import LaggedActuator, ResonantActuator
from rt_torchrl.plants.neural_residual import NeuralResidual
from rt_torchrl.plants.plant import Plant

if TYPE_CHECKING:
    from rt_torchrl.envs.flapping_wing.plant import FlappingWing

LAG = 0.05  # [s]; one wing beat, with which the identification begins
DEAD_TIME = 0.1  # [s]
FREQUENCY, DAMPING = 10.0, 0.5  # [rad/s], [-]; an elastic mount that settles within some tenths of a second
SHORT_DEAD_TIME = 0.02  # [s]; of a link that the mount follows
UNKNOWN_ACCELERATION = 2.0  # [m/s²]; a fifth of gravity
AMPLITUDE, PLANE = "flapping_amplitude", "stroke_plane_angle"


def suspects(plant: "FlappingWing") -> Mapping[str, Plant]:
    """Lags and dead times of the stroke plane and of the amplitude, and an elastic stroke plane behind a dead time."""

    def lagging(base: Plant, action: str) -> Plant:
        return LaggedActuator(base, action, LAG)

    def late(base: Plant, action: str) -> Plant:
        return LaggedActuator(base, action, DEAD_TIME, stages=4)

    def swinging(base: Plant) -> Plant:
        return ResonantActuator(base, PLANE, FREQUENCY, DAMPING)

    def after(base: Plant, action: str) -> Plant:
        return LaggedActuator(base, action, SHORT_DEAD_TIME, stages=2)

    return {
        "plane lags": lagging(plant, PLANE),
        "plane late": late(plant, PLANE),
        "both lag": lagging(lagging(plant, PLANE), AMPLITUDE),
        "both late": late(late(plant, PLANE), AMPLITUDE),
        "plane swings, late": after(swinging(plant), PLANE),
        "plane swings, both late": late(late(swinging(plant), PLANE), AMPLITUDE),
    }


def further_suspects(plant: "FlappingWing") -> Mapping[str, Plant]:
    """A force of unknown form that depends on the velocity, both actuators and the headwind."""
    force = NeuralResidual(
        plant,
        {"forward_speed": UNKNOWN_ACCELERATION, "climb_speed": UNKNOWN_ACCELERATION},
        inputs=("forward_speed", "climb_speed", AMPLITUDE, PLANE, "headwind"),
        ranges={"forward_speed": (-3.0, 3.0), "climb_speed": (-3.0, 3.0), "headwind": (-3.0, 3.0)},
    )
    return {"unknown force": force}
