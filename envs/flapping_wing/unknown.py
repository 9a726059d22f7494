"""Real drones that their twin does not know, by name; parameters without a source are engineering guesses."""

from collections.abc import Mapping, Sequence
from functools import partial

from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.plants.actuators import LaggedActuator, ResonantActuator, ScaledActuator
from rt_torchrl.plants.coefficients import LaggedCoefficients
from rt_torchrl.plants.extension import System, combined, require_systems
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.sensors import UnreadInput

AMPLITUDE, PLANE = "flapping_amplitude", "stroke_plane_angle"
STAGES = 12
"""Number of lags of a dead time, whose response thus rises within 30 % of it."""


def tilting(plant: Plant, *, frequency: float, damping: float) -> Plant:
    """A stroke plane that a weak servo tilts.

    Frequency [rad/s] and damping: engineering guesses; a servo of a drone of 3 g turns the plane within some 0.2 s.
    """
    return ResonantActuator(plant, PLANE, frequency, damping)


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


def sagging(plant: Plant) -> Plant:
    """A battery whose voltage sags, and with it the amplitude.

    Loss 5 %: engineering guess.
    """
    return ScaledActuator(plant, AMPLITUDE, 0.95)


def gusty(plant: Plant) -> Plant:
    """Gusts that the wind sensor on the ground does not read.

    Deviation 0.5 m/s: engineering guess, half that of the wind that is read. Frequencies 0.9, 2.1 and 4.7 rad/s:
    engineering guess, faster than the wind that is read (3 s) and slower than the wing beat.
    """
    return UnreadInput(plant, "headwind", 0.5, (0.9, 2.1, 4.7))


def lifting_late(plant: FlappingWing) -> Plant:
    """Blade elements whose lift and drag follow the flow with a lag, as after Wagner.

    Time constant 2 ms: two to three half chords of 5 mm at the 6 m/s of a wing's middle, the time in which Wagner's
    function makes up half of what is missing.
    """
    elements = (plant.span_nodes,)
    return LaggedCoefficients(plant, 2e-3, (0.0, 0.0) * plant.span_nodes, elements=elements)


PARTS = ("wings", "wind", "supply", "stroke plane", "drives", "link")
"""Parts of the drone, in the order in which they are changed: what is next to the body comes first."""
SYSTEMS: Mapping[str, System] = {
    "plane_4.4": {"stroke plane": partial(tilting, frequency=4.4, damping=0.3)},
    "plane_6.3": {"stroke plane": partial(tilting, frequency=6.3, damping=0.4)},
    "plane_12.6": {"stroke plane": partial(tilting, frequency=12.6, damping=0.4)},
    "delay": {"link": partial(late, delay=0.2)},
    "sag": {"supply": sagging},
    "gust": {"wind": gusty},
    "lift_lag": {"wings": lifting_late},
    "all_1": {
        "wind": gusty,
        "supply": sagging,
        "stroke plane": partial(tilting, frequency=9.4, damping=0.4),
        "drives": partial(lagging, amplitude=0.1, plane=0.05),
        "link": partial(late, delay=0.1),
    },
    "all_2": {
        "wind": gusty,
        "supply": sagging,
        "stroke plane": partial(tilting, frequency=6.3, damping=0.3),
        "drives": partial(lagging, amplitude=0.15),
        "link": partial(late, delay=0.2),
    },
}
"""What the real drone has beside its twin, by the names of ``--unknown``."""


def require_unknown(names: Sequence[str]) -> None:
    """Refuse names that do not exist, or change the same part.

    Raises:
        ValueError: if there are such names.
    """
    require_systems(names, SYSTEMS)


def unknown(plant: FlappingWing, names: Sequence[str]) -> Plant:
    """The real drone that has all that the names say; its twin is ``plant``.

    Raises:
        ValueError: if a name does not exist, or two of them change the same part.
    """
    return combined(plant, names, SYSTEMS, PARTS)
