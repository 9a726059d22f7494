"""The plant within extensions."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rt_torchrl.plants.plant import Plant


def innermost(plant: "Plant") -> "Plant":
    """The plant that extensions extend, or the plant itself if it extends none."""
    from rt_torchrl.plants.plant import Plant  # here, because the module of plants imports this one

    while isinstance(base := getattr(plant, "base", None), Plant):
        plant = base
    return plant
