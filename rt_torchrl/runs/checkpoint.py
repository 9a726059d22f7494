"""Save a training after any episode and go on with it later, to the bit."""

from pathlib import Path
from typing import Any

import torch

from rt_torchrl.twinning.algorithm import ReinforcementTwinning

FORMAT = 3


def state_of(algorithm: ReinforcementTwinning) -> dict[str, Any]:
    """Everything that the next episode depends on."""
    return {"format": FORMAT, "plant": algorithm.twin.plant.name, "algorithm": algorithm.state_dict()}


def restore(algorithm: ReinforcementTwinning, state: dict[str, Any]) -> None:
    """Put an algorithm, built with the same configuration, into a saved state.

    Raises:
        ValueError: if the state is of another plant, or does not fit.
    """
    name = algorithm.twin.plant.name
    if state["plant"] != name:
        raise ValueError(f"the checkpoint is of plant {state['plant']!r}, this training of {name!r}; use its recipe.")
    try:
        algorithm.load_state_dict(state["algorithm"])
    except ValueError as error:
        raise ValueError(
            f"the checkpoint's weights do not fit this training of {name!r}; start with the options it was started "
            f"with (see its config.json). {error}"
        ) from error


def save(path: Path, algorithm: ReinforcementTwinning, episodes: list[dict[str, Any]]) -> None:
    """Write a checkpoint; an interrupt while writing leaves the one before intact."""
    partial = path.with_suffix(".partial")
    torch.save({**state_of(algorithm), "episodes": episodes}, partial)
    partial.replace(path)


def load(path: Path, algorithm: ReinforcementTwinning) -> list[dict[str, Any]]:
    """Restore a checkpoint and return the records of its episodes.

    Raises:
        ValueError: if there is none at ``path``, it is of another format or plant, or its weights do not fit.
    """
    if not path.is_file():
        raise ValueError(f"there is no checkpoint {path} to resume from; start without --resume.")
    # Written by save(); holds records and processes beside weights, which weights_only would refuse.
    state = torch.load(path, weights_only=False, map_location=algorithm.generator.device)
    if state.get("format") != FORMAT:
        raise ValueError(f"{path} has checkpoint format {state.get('format')}; this version reads format {FORMAT}.")
    restore(algorithm, state)
    return state["episodes"]
