"""A check of the name and the signals that a plant declares."""

import math
from collections.abc import Iterator

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

GROUPS = {"states": "n_s", "actions": "n_a", "inputs": "n_z", "observations": "n_o"}


def signals(plant: Plant) -> Iterator[str]:
    """Violations in the plant's name, in its four tuples of signals, and in the names of the controller's states."""
    name = getattr(plant, "name", None)
    if not isinstance(name, str) or not name.isidentifier():
        yield f"name: is {name!r}; give the class a name such as name = 'two_tanks', which run folders are called by."
    for group in GROUPS:
        declared = getattr(plant, group, None)
        if not isinstance(declared, tuple) or not all(isinstance(signal, Signal) for signal in declared):
            yield f"{group}: is {declared!r}; expected a tuple of Signal, declared on the class."
            continue
        if not declared and group != "inputs":
            yield f"{group}: is empty; declare at least one Signal (only inputs may be empty)."
        yield from _of_group(group, declared)
    yield from _of_controller(plant)


def _of_controller(plant: Plant) -> Iterator[str]:
    names = [getattr(signal, "name", None) for signal in getattr(plant, "states", None) or ()]
    for name in plant.controller_states:
        if name not in names:
            yield f"controller_states: {name!r} is no state; it must be one of {', '.join(map(str, names))}."


def _of_group(group: str, declared: tuple[Signal, ...]) -> Iterator[str]:
    names = [signal.name for signal in declared]
    for name in dict.fromkeys(name for name in names if names.count(name) > 1):
        yield f"{group}: {name!r} is declared {names.count(name)} times; give every signal a name of its own."
    for signal in declared:
        for attribute in ("unit", "symbol"):
            if not getattr(signal, attribute):
                yield f"{group}: {signal.name!r} has no {attribute}; give one (unit='-' for a number without unit)."
        bounded = math.isfinite(signal.low) and math.isfinite(signal.high)
        if group == "actions" and not bounded:
            yield (
                f"actions: {signal.name!r} has range [{signal.low}, {signal.high}] {signal.unit}; policies and "
                "exploration need finite limits: give the Signal the actuator's low and high."
            )
