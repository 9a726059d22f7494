"""What the real systems of several plants have beside their twins, by the names of ``--unknown``."""

from collections.abc import Mapping, Sequence

from rt_torchrl.plants.extension import System, require_systems


def by_plant(names: Sequence[str], systems: Mapping[str, Mapping[str, System]]) -> dict[str, tuple[str, ...]]:
    """The names of each plant. A name counts for every plant that has it, and each plant needs one.

    Args:
        names: names of what the real systems have beside their twins; none for the plants as their twins know them.
        systems: the plants, each with its systems by name.

    Returns:
        The names of each plant in the order of its systems, so that the same systems have the same names.

    Raises:
        ValueError: if a name is on none of the plants, a plant has none of the names, or two names of a plant change
            the same part of it.
    """
    if not names:
        return dict.fromkeys(systems, ())
    known = "; ".join(f"{plant}: {', '.join(of_plant)}" for plant, of_plant in systems.items())
    if nowhere := [name for name in names if not any(name in of_plant for of_plant in systems.values())]:
        raise ValueError(f"unknown={tuple(names)}: {', '.join(nowhere)} is on none of these plants; choose {known}.")
    if idle := [plant for plant, of_plant in systems.items() if not set(names) & set(of_plant)]:
        raise ValueError(
            f"unknown={tuple(names)}: none of them is on {', '.join(idle)}. Name the plants that are meant by "
            f"--plants, or give a name for each plant; {known}."
        )
    for of_plant in systems.values():
        require_systems([name for name in names if name in of_plant], of_plant)
    return {plant: tuple(name for name in of_plant if name in names) for plant, of_plant in systems.items()}
