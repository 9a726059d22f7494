"""Real systems by name: what a plant has beside its own dynamics, which nobody tells its twin."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rt_torchrl.plants.plant import Plant

Change = Callable[[Any], Plant]
"""A function that makes another plant of a plant."""
System = Mapping[str, Change]
"""What makes a real system of a plant, by the part of the plant that it changes."""


def require_systems(names: Sequence[str], systems: Mapping[str, System]) -> None:
    """Refuse names of real systems that do not exist, or cannot be combined.

    Args:
        names: names of the systems that are combined.
        systems: all systems, by name.

    Raises:
        ValueError: if a name does not exist, or two of the systems change the same part.
    """
    missing = [name for name in names if name not in systems]
    if missing:
        raise ValueError(f"unknown={tuple(names)}: {', '.join(missing)} does not exist; choose {', '.join(systems)}.")
    changed: dict[str, str] = {}
    for name in names:
        for part in systems[name]:
            if part in changed:
                raise ValueError(
                    f"unknown={tuple(names)}: {changed[part]} and {name} both change the {part}; give one of them."
                )
            changed[part] = name


def combined(plant: Plant, names: Sequence[str], systems: Mapping[str, System], parts: Sequence[str]) -> Plant:
    """The plant with all that the named systems have beside it.

    Args:
        plant: the plant that a twin knows.
        names: names of the systems; none gives the plant.
        systems: all systems, by name.
        parts: all parts of the plant that a system may change, in the order in which the changes are made.

    Raises:
        ValueError: as :func:`require_systems`.
    """
    require_systems(names, systems)
    changes = {part: change for name in names for part, change in systems[name].items()}
    for part in parts:
        plant = changes[part](plant) if part in changes else plant
    return plant
