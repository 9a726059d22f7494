"""Real systems that their twins do not know, of every plant; each plant has a catalogue of its own."""

from collections.abc import Mapping, Sequence

from rt_torchrl.envs.cryogenic_tank import unknown as tank
from rt_torchrl.envs.flapping_wing import unknown as drone
from rt_torchrl.envs.wind_turbine import unknown as turbine
from rt_torchrl.plants.extension import System, require_systems

SYSTEMS: Mapping[str, Mapping[str, System]] = {
    "wind_turbine": turbine.SYSTEMS,
    "flapping_wing": drone.SYSTEMS,
    "cryogenic_tank": tank.SYSTEMS,
}
"""What the real system of each plant may have beside its twin, by the names of ``--unknown``."""


def require_unknown(plant: str, names: Sequence[str]) -> None:
    """Refuse names that a plant does not have, or that change the same part of it.

    Args:
        plant: name of the plant's recipe.
        names: names of what its real system has beside its twin.

    Raises:
        ValueError: if there are such names.
    """
    require_systems(names, SYSTEMS[plant])
