"""Checkpoints of a training after an episode, from which it goes on as if it had never stopped, to the bit."""

import errno
import os
import re
from pathlib import Path
from typing import Any

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.runs.tensor_file import DamagedFileError, load_tensors, save_tensors

NAME = "checkpoint.pt"
"""File of the newest checkpoint in a run folder."""
FORMAT = 5
NUMBERED = re.compile(r".+-(?P<episodes>[0-9]+)\.\w+")
"""Name of an earlier checkpoint."""
FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a full disk and of a used quota."""
ANEW = "To train anew in this folder, use --overwrite."


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


def save(path: Path, algorithm: ReinforcementTwinning, episodes: list[dict[str, Any]], *, kept: int = 1) -> str | None:
    """Write a checkpoint; the earlier checkpoint stays intact until the new one is complete.

    Args:
        path: file of the newest checkpoint. Earlier ones lie beside it, with their number of episodes in their name.
        algorithm: algorithm to save.
        episodes: records of the episodes that are done.
        kept: number of checkpoints that are kept, with the new one.

    Returns:
        None; or, if the disk is full and earlier checkpoints had to go to make room, a sentence that says so.

    Raises:
        ValueError: if a component's state, such as an environment's, holds more than tensors, numbers and strings.
        OSError: if the checkpoint cannot be written.
    """
    content = {"format": FORMAT, "episodes": episodes, "state": state_of(algorithm)}
    if kept > 1 and path.is_file():
        _keep(path, len(episodes) - 1)
    try:
        save_tensors(path, content)
    except OSError as error:
        older = earlier(path)
        if error.errno not in FULL or not older:
            raise
        for old in older:
            old.unlink(missing_ok=True)
        save_tensors(path, content)
        return f"the disk of {path.parent} is full; {len(older)} earlier checkpoints went to save the present one"
    for old in earlier(path)[max(0, kept - 1) :]:
        old.unlink(missing_ok=True)
    return None


def earlier(path: Path) -> list[Path]:
    """The checkpoints beside the newest one, latest first."""
    found = {file: NUMBERED.fullmatch(file.name) for file in path.parent.glob(f"{path.stem}-*{path.suffix}")}
    numbers = {file: int(match["episodes"]) for file, match in found.items() if match}
    return sorted(numbers, key=numbers.__getitem__, reverse=True)


def exists(path: Path) -> bool:
    """Whether there is a checkpoint to go on from, at ``path`` or an earlier one beside it."""
    return path.is_file() or bool(earlier(path))


def load(path: Path, algorithm: ReinforcementTwinning) -> list[dict[str, Any]]:
    """Restore the newest checkpoint that is sound, and return the records of its episodes.

    If that is not the one at ``path``, a line on the terminal says so, and the damaged file is renamed.

    Raises:
        ValueError: if there is no checkpoint, all of them are damaged, or the newest sound one has another format,
            belongs to another plant, or does not fit.
        OSError: if a checkpoint cannot be read, which does not make it a damaged one; nothing is renamed.
    """
    candidates = [*([path] if path.is_file() else []), *earlier(path)]
    if not candidates:
        raise ValueError(f"there is no checkpoint {path} to go on from.")
    damaged: dict[Path, DamagedFileError] = {}
    for file in candidates:
        try:
            found = _read(file)
        except DamagedFileError as error:
            damaged[file] = error
            continue
        try:
            _restore(file, found, algorithm)
        except ValueError as error:
            raise ValueError(f"{error} {ANEW}") from error
        _set_aside(damaged, file, len(found["episodes"]))
        return found["episodes"]
    reasons = " ".join(map(str, damaged.values()))
    raise ValueError(f"{reasons} {ANEW}") from damaged[candidates[0]]


def _read(file: Path) -> dict[str, Any]:
    """The content of a checkpoint of any format."""
    found = load_tensors(file)
    if not {"format", "episodes", "state"} <= found.keys():
        raise DamagedFileError(
            f"{file} is damaged, or no checkpoint: it holds {', '.join(map(str, found)) or 'nothing'}."
        )
    return found


def _restore(file: Path, found: dict[str, Any], algorithm: ReinforcementTwinning) -> None:
    if found["format"] != FORMAT:
        raise ValueError(f"{file} has checkpoint format {found['format']}; this version reads format {FORMAT}.")
    restore(algorithm, found["state"])


def _set_aside(damaged: dict[Path, DamagedFileError], sound: Path, episodes: int) -> None:
    """Say which checkpoint was taken in the place of damaged ones, and keep these under another name."""
    for file, error in damaged.items():
        aside = file.with_name(f"{file.name}.damaged")
        file.replace(aside)
        print(f"{error} It is now {aside.name}; the training goes on from {sound.name}, after {episodes} episodes.")


def _keep(path: Path, episodes: int) -> None:
    """Keep the newest checkpoint under the name of an earlier one, without a moment in which there is none."""
    numbered = path.with_name(f"{path.stem}-{episodes:04d}{path.suffix}")
    numbered.unlink(missing_ok=True)
    try:
        os.link(path, numbered)
    except OSError:
        if not path.is_file():
            raise
        write_atomically(numbered, path.read_bytes())  # a file system without links
