"""Finds the plants that are installed, by their folders: there is no registry to edit."""

import importlib
import inspect
import pkgutil

import rt_torchrl.envs
from rt_torchrl.plants.plant import Plant


def shipped_plants() -> dict[str, type[Plant]]:
    """The plant of each folder under ``rt_torchrl.envs``, by the folder's name."""
    return {m.name: plant_of(m.name) for m in pkgutil.iter_modules(rt_torchrl.envs.__path__) if m.ispkg}


def plant_of(folder: str) -> type[Plant]:
    """The one plant that ``<folder>/plant.py`` defines.

    Raises:
        ValueError: if there is none, or more than one.
    """
    module = importlib.import_module(f"rt_torchrl.envs.{folder}.plant")
    found = [
        kind
        for kind in vars(module).values()
        if inspect.isclass(kind) and issubclass(kind, Plant) and kind.__module__ == module.__name__
    ]
    if len(found) != 1:
        raise ValueError(f"{module.__name__} defines {len(found)} plants; a folder under envs holds exactly one.")
    return found[0]
