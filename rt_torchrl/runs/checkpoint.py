"""Save a training after any episode and go on with it later, to the bit."""

from pathlib import Path
from typing import Any

from rt_torchrl.runs.tensor_file import load_tensors, save_tensors
from rt_torchrl.twinning.algorithm import ReinforcementTwinning

FORMAT = 3


def state_of(algorithm: ReinforcementTwinning) -> dict[str, Any]:
    """Everything that the next episode depends on: tensors, numbers and strings in dicts, lists and tuples."""
    return {"plant": algorithm.twin.plant.name, "algorithm": algorithm.state_dict()}


def restore(algorithm: ReinforcementTwinning, state: dict[str, Any]) -> None:
    """Put an algorithm, built with the same configuration, into a saved state.

    Raises:
        ValueError: if the state is of another plant, or does not fit.
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
    """Write a checkpoint; whatever happens while it is written leaves the one before intact.

    Raises:
        ValueError: if a part's state is more than tensors, numbers and strings, such as an environment's.
        OSError: if it cannot be written.
    """
    save_tensors(path, {"format": FORMAT, "episodes": episodes, "state": state_of(algorithm)})


def load(path: Path, algorithm: ReinforcementTwinning) -> list[dict[str, Any]]:
    """Restore a checkpoint and return the records of its episodes.

    Raises:
        ValueError: if there is none at ``path``, it is damaged, of another format or plant, or does not fit.
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
