"""The plant that the options of a recipe make."""

from typing import Protocol, runtime_checkable

from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.run_config import RunConfig


@runtime_checkable
class MakesPlant(Protocol):
    """A configuration whose options say all that its plant needs."""

    def plant(self) -> Plant:
        """The real system in simulation, new."""
        ...


def plant_of(config: RunConfig) -> Plant:
    """The real system in simulation, as the configuration makes it.

    Raises:
        ValueError: if the configuration has no method ``plant()``.
    """
    if not isinstance(config, MakesPlant):
        raise ValueError(
            f"{type(config).__qualname__} has no method plant() that makes the plant from its options; write one."
        )
    return config.plant()


def physics_of(config: RunConfig) -> Plant:
    """The physics of the twin, by which policies and controllers are made: what is believed, or the real system's."""
    return config.believed() or plant_of(config)


def require_plant(argument: str, given: object) -> None:
    """Refuse what is no plant, such as a class of plants.

    Raises:
        ValueError: if it is none; the message names the argument.
    """
    if not isinstance(given, Plant):
        raise ValueError(f"{argument}={given!r} must be a plant; if this is a class, give an instance of it.")
