"""Plants, found by their folders or by the place of their definition, so that there is no registry to edit."""

import importlib
import inspect
import pkgutil

import rt_torchrl.envs
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.user_code import named


def shipped_plants() -> dict[str, type[Plant]]:
    """The plant class of each folder under ``rt_torchrl.envs``, by the folder's name."""
    return {m.name: plant_of(m.name) for m in pkgutil.iter_modules(rt_torchrl.envs.__path__) if m.ispkg}


def plant_class(name: str) -> type[Plant]:
    """The plant class that a name stands for.

    Args:
        name: folder of the plant under ``rt_torchrl.envs``, or ``FILE.py:NAME`` or ``package.module:NAME``.

    Raises:
        ValueError: if there is no such plant.
    """
    known = shipped_plants()
    if ":" not in name:
        if name not in known:
            raise ValueError(
                f"plant={name!r} does not exist; choose one of {', '.join(known)}, or name one of your own as "
                "FILE.py:NAME or package.module:NAME."
            )
        return known[name]
    found = named(name)
    if not (inspect.isclass(found) and issubclass(found, Plant)):
        raise ValueError(f"plant={name!r} is no class derived from Plant.")
    return found


def plant_of(folder: str) -> type[Plant]:
    """The one plant class that ``<folder>/plant.py`` defines.

    Raises:
        ValueError: if it defines no plant, or more than one.
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
