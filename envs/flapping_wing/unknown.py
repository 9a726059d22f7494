"""What a real drone may have beside its twin: systems by name, and what the plant suspects.

Parameters without a source are engineering guesses.
"""

from collections.abc import Mapping
from functools import partial

from rt_torchrl.plants.actuators import (
    LaggedActuator,
    PlayActuator,
    RateLimitedActuator,
    ResonantActuator,
    ScaledActuator,
)
from rt_torchrl.plants.extension import Catalogue, System
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.vector_field import NeuralResidual

AMPLITUDE, PLANE = "flapping_amplitude", "stroke_plane_angle"
STAGES = 12
"""Number of lags of a dead time, whose response thus rises within 30 % of it."""
FIRST_LAG, FIRST_DELAY, SHORT_DELAY = 0.05, 0.1, 0.02
"""Lag of a wing beat, and dead times of both actuators and of a link that an elastic plane follows [s].

The identification begins with them.
"""
FIRST_FREQUENCY, FIRST_DAMPING = 10.0, 0.5
"""Elastic mount of the stroke plane [rad/s], [-] with which the identification begins; it settles within 1 s."""
UNKNOWN_ACCELERATION = 2.0
"""Size of an unknown acceleration [m/s²], a fifth of gravity."""


tilting = partial(ResonantActuator, action=PLANE)
"""A stroke plane that a weak servo tilts.

Frequency [rad/s] and damping: engineering guesses; a servo of a drone of 3 g turns the plane within some 0.2 s.
"""


def late(plant: Plant, *, delay: float) -> Plant:
    """Actions that come late, over a link and the computation on the ground.

    Delay [s] of both actions: engineering guess; vision systems and radio links take 0.05 to 0.2 s.
    """
    return LaggedActuator(LaggedActuator(plant, PLANE, delay, stages=STAGES), AMPLITUDE, delay, stages=STAGES)


def lagging(plant: Plant, *, amplitude: float, plane: float | None = None) -> Plant:
    """Motors that reach a new amplitude, and a servo that reaches a new angle, with a lag of first order.

    Time constants [s]: engineering guesses, one to three wing beats.
    """
    lagged = LaggedActuator(plant, AMPLITUDE, amplitude)
    return lagged if plane is None else LaggedActuator(lagged, PLANE, plane)


sagging = partial(ScaledActuator, action=AMPLITUDE, gain=0.95)
"""A battery whose voltage sags, and with it the amplitude.

Loss 5 %: engineering guess.
"""


PARTS = ("supply", "stroke plane", "drives", "link")
"""Parts of the drone, in the order in which they are changed: what is next to the body comes first."""
SYSTEMS: Mapping[str, System] = {
    "plane_4.4": {"stroke plane": partial(tilting, frequency=4.4, damping=0.3)},
    "plane_6.3": {"stroke plane": partial(tilting, frequency=6.3, damping=0.4)},
    "plane_12.6": {"stroke plane": partial(tilting, frequency=12.6, damping=0.4)},
    "delay": {"link": partial(late, delay=0.2)},
    "sag": {"supply": sagging},
    "plane_rate": {"stroke plane": partial(RateLimitedActuator, action=PLANE, size=60.0)},
    "amplitude_play": {"supply": partial(PlayActuator, action=AMPLITUDE, size=3.0)},
    "plane_play": {"stroke plane": partial(PlayActuator, action=PLANE, size=4.0)},
    "all_1": {
        "supply": sagging,
        "stroke plane": partial(tilting, frequency=9.4, damping=0.4),
        "drives": partial(lagging, amplitude=0.1, plane=0.05),
        "link": partial(late, delay=0.1),
    },
    "all_2": {
        "supply": sagging,
        "stroke plane": partial(tilting, frequency=6.3, damping=0.3),
        "drives": partial(lagging, amplitude=0.15),
        "link": partial(late, delay=0.2),
    },
}
"""What the real drone has beside its twin, by the names of ``--unknown``."""


unknown = Catalogue(SYSTEMS, PARTS)
"""``unknown(plant, names)`` is the real drone that has all that the names say; its twin is ``plant``."""


def suspects(plant: Plant) -> Mapping[str, Plant]:
    """Lags and dead times of the stroke plane and of the amplitude, and an elastic stroke plane behind a dead time."""

    def delayed(base: Plant, action: str) -> Plant:
        return LaggedActuator(base, action, FIRST_DELAY, stages=4)

    def swinging() -> Plant:
        return tilting(plant, frequency=FIRST_FREQUENCY, damping=FIRST_DAMPING)

    return {
        "plane lags": LaggedActuator(plant, PLANE, FIRST_LAG),
        "plane late": delayed(plant, PLANE),
        "both lag": LaggedActuator(LaggedActuator(plant, PLANE, FIRST_LAG), AMPLITUDE, FIRST_LAG),
        "both late": delayed(delayed(plant, PLANE), AMPLITUDE),
        "plane swings, late": LaggedActuator(swinging(), PLANE, SHORT_DELAY, stages=2),
        "plane swings, both late": delayed(delayed(swinging(), PLANE), AMPLITUDE),
    }


def further_suspects(plant: Plant) -> Mapping[str, Plant]:
    """A force of unknown form that depends on the velocity, both actuators and the headwind."""
    force = NeuralResidual(
        plant,
        {"forward_speed": UNKNOWN_ACCELERATION, "climb_speed": UNKNOWN_ACCELERATION},
        inputs=("forward_speed", "climb_speed", AMPLITUDE, PLANE, "headwind"),
        ranges={"forward_speed": (-3.0, 3.0), "climb_speed": (-3.0, 3.0), "headwind": (-3.0, 3.0)},
    )
    return {"unknown force": force}
