"""Checkpoints of a training after an episode, from which it goes on as if it had never stopped, to the bit."""

from pathlib import Path
from typing import Any

from rt_torchrl.runs.tensor_file import load_tensors, save_tensors
from rt_torchrl.twinning.algorithm import ReinforcementTwinning

FORMAT = 3


def state_of(algorithm: ReinforcementTwinning) -> dict[str, Any]:
    """Everything that the next episode depends on: tensors, numbers and strings in dicts, lists and tuples."""
    return {"plant": algorithm.twin.plant.name, "algorithm": algorithm.state_dict()}


def restore(algorithm: ReinforcementTwinning, state: dict[str, Any]) -> None:
    """Put an algorithm that was built with the same configuration into a saved state.

    Raises:
        ValueError: if the state belongs to another plant, or does not fit.
    """
    name = algorithm.twin.plant.name
    if state.get("plant") != name:
        raise ValueError(
            f"the checkpoint is of plant {state.get('plant')!r}, this training of {name!r}; use its recipe."
        )
    try:
        algorithm.load_state_dict(state["algorithm"])
    except (KeyError, ValueError) as error:
        raise ValueError(
            f"the checkpoint's weights do not fit this training of {name!r}; start with the options it was started "
            f"with (see its config.json). {type(error).__name__}: {error}"
        ) from error


def save(path: Path, algorithm: ReinforcementTwinning, episodes: list[dict[str, Any]]) -> None:
    """Write a checkpoint; the earlier checkpoint stays intact until the new one is complete.

    Raises:
        ValueError: if a component's state, such as an environment's, holds more than tensors, numbers and strings.
        OSError: if the checkpoint cannot be written.
    """
    save_tensors(path, {"format": FORMAT, "episodes": episodes, "state": state_of(algorithm)})


def load(path: Path, algorithm: ReinforcementTwinning) -> list[dict[str, Any]]:
    """Restore a checkpoint and return the records of its episodes.

    Raises:
        ValueError: if there is no checkpoint at ``path``, or it is damaged, has another format, belongs to another
            plant, or does not fit.
    """
    if not path.is_file():
        raise ValueError(f"there is no checkpoint {path} to go on from.")
    try:
        found = load_tensors(path)
        if found.get("format") != FORMAT:
            raise ValueError(f"{path} has checkpoint format {found.get('format')}; this version reads format {FORMAT}.")
        restore(algorithm, found["state"])
    except ValueError as error:
        raise ValueError(f"{error} To train anew in this folder, use --overwrite.") from error
    return found["episodes"]
