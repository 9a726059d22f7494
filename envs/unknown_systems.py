"""Real systems that their twins do not know, of every plant; each plant has a catalogue of its own."""

from collections.abc import Mapping

from rt_torchrl.envs.cryogenic_tank import unknown as tank
from rt_torchrl.envs.flapping_wing import unknown as drone
from rt_torchrl.envs.wind_turbine import unknown as turbine
from rt_torchrl.plants.extensions.catalogue import System

SYSTEMS: Mapping[str, Mapping[str, System]] = {
    "wind_turbine": turbine.SYSTEMS,
    "flapping_wing": drone.SYSTEMS,
    "cryogenic_tank": tank.SYSTEMS,
}
"""What the real system of each plant may have beside its twin, by the names of ``--unknown``."""
