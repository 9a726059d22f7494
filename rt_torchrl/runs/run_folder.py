"""The folder of a run: its lock, its checkpoints, and its files of tensors, whose damage is noticed."""

import errno
import io
import os
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import filelock
import numpy as np
import torch

from rt_torchrl.atomic_file import make_folder, new_folder, remove_partials, write_atomically
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.settings import FILE, read_settings, require_same, write_settings

if TYPE_CHECKING:
    from rt_torchrl.algorithm import ReinforcementTwinning  # only its type: who reads weights needs no TorchRL


class DamagedFileError(ValueError):
    """A file that is not what a run has written: damaged, foreign, or such that loading it would run code."""


def save_tensors(path: Path, content: Mapping[str, Any]) -> None:
    """Write tensors, numbers and strings in dicts, lists and tuples; ``torch.load`` can read the file too.

    The tensors of the file are on the CPU, so that a machine without the device of the run reads it.

    Raises:
        ValueError: if ``content`` holds anything else; it names the place.
        OSError: if the file cannot be written, see :func:`write_atomically`.
    """
    buffer = io.BytesIO()
    torch.save(plain(content), buffer)
    write_atomically(path, buffer.getvalue())


def load_tensors(path: Path) -> dict[str, Any]:
    """The content that :func:`save_tensors` wrote, on the CPU.

    The checksums of the file, which is a zip archive, are compared first.

    Raises:
        DamagedFileError: if the file is damaged, or holds any object that is not a tensor or a plain container; such an
            object is not built.
        OSError: if the file cannot be read, or memory is short, which says nothing of what it holds.
    """
    try:
        return _loaded(path)
    except (OSError, MemoryError) as error:
        number = errno.ENOMEM if isinstance(error, MemoryError) else error.errno
        reason = os.strerror(number) if number else str(error)
        raise OSError(number, f"{reason}; the file is not read and not changed, try again", str(path)) from error


def _loaded(path: Path) -> dict[str, Any]:
    file = path.read_bytes()
    try:
        with zipfile.ZipFile(io.BytesIO(file)) as archive:
            if (wrong := archive.testzip()) is not None:
                raise DamagedFileError(f"{path} is damaged: {wrong} does not have the checksum it was written with.")
        content = torch.load(io.BytesIO(file), weights_only=True, map_location="cpu")
    except (MemoryError, DamagedFileError):
        raise
    except pickle.UnpicklingError as error:
        raise DamagedFileError(
            f"{path} is not loaded: it is of another version, or it would run code, because it holds more than tensors "
            f"in plain containers. {first_line(error)}"
        ) from error
    except Exception as error:  # of many kinds
        if "allocate memory" in str(error):  # torch has no class of its own for it on the CPU
            raise MemoryError from error
        raise DamagedFileError(f"{path} is damaged, or no file of a run: {first_line(error)}") from error
    if not isinstance(content, dict):
        raise DamagedFileError(f"{path} is no file of a run: it holds a {type(content).__name__}.")
    return content


def first_line(error: Exception) -> str:
    """First line of an error's message, without the advice that torch adds after it."""
    return f"({(str(error).splitlines() or [type(error).__name__])[0]})"


def plain(value: Any, place: str = "") -> Any:
    """The value with only Python's own containers and numbers, and with plain tensors on the CPU.

    Raises:
        ValueError: if it holds anything but tensors, numbers and strings; it names the place.
    """
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().as_subclass(torch.Tensor)
    value = value.item() if isinstance(value, np.generic) else value
    for kind in (bool, int, float, str):
        if isinstance(value, kind):  # also one of a derived class
            return kind(value)
    if value is None:
        return None
    if isinstance(value, Mapping):
        return {key: plain(entry, f"{place}[{key!r}]") for key, entry in value.items()}
    if type(value) in (list, tuple, torch.Size):
        entries = [plain(entry, f"{place}[{k}]") for k, entry in enumerate(value)]
        return entries if isinstance(value, list) else tuple(entries)
    raise ValueError(
        f"{place or 'content'} of what is to be saved is a {type(value).__name__}; a state_dict may hold tensors, "
        "numbers and strings, in dicts, lists and tuples."
    )


FORMAT = 7
KEPT = 3
"""Number of latest checkpoints that are kept; if one is damaged, the run goes on from the one before."""
FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a full disk and of a used quota."""
ANEW = "To train anew, choose another folder."


def save_checkpoint(folder: Path, algorithm: "ReinforcementTwinning", episodes: list[dict[str, Any]]) -> str | None:
    """Write a checkpoint, whose name has the number of episodes; earlier ones stay until it is complete.

    Args:
        folder: run folder.
        algorithm: algorithm to save.
        episodes: records of the episodes that are done.

    Returns:
        None; or, if the disk is full and earlier checkpoints had to go to make room, a sentence that says so.

    Raises:
        ValueError: if a component's state, such as an environment's, holds more than tensors, numbers and strings.
        OSError: if the checkpoint cannot be written.
    """
    content = {
        "format": FORMAT,
        "episodes": episodes,
        "state": {"plant": algorithm.twin.plant.name, "algorithm": algorithm.state_dict()},
    }
    path, older = folder / f"checkpoint-{len(episodes):04d}.pt", checkpoints(folder)[1:]
    try:
        save_tensors(path, content)
    except OSError as error:
        if error.errno not in FULL or not older:
            raise
        for old in older:
            old.unlink(missing_ok=True)
        save_tensors(path, content)
        return f"the disk of {folder} is full; {len(older)} earlier checkpoints went to save the present one"
    for old in checkpoints(folder)[KEPT:]:
        old.unlink(missing_ok=True)
    return None


def checkpoints(folder: Path) -> list[Path]:
    """The checkpoints of a run, latest first."""
    numerals = {file: file.stem.removeprefix("checkpoint-") for file in folder.glob("checkpoint-*.pt")}
    numbers = {file: int(number) for file, number in numerals.items() if number.isdecimal()}
    return sorted(numbers, key=numbers.__getitem__, reverse=True)


def load_checkpoint(folder: Path, algorithm: "ReinforcementTwinning") -> list[dict[str, Any]]:
    """Restore the newest checkpoint that is sound, and return the records of its episodes.

    If that is not the newest of all, a line on the terminal says so, and the damaged files are renamed.

    Raises:
        ValueError: if there is no checkpoint, all of them are damaged, or the newest sound one has another format,
            belongs to another plant, or does not fit.
        OSError: if a checkpoint cannot be read, which does not make it a damaged one; nothing is renamed.
    """
    damaged: dict[Path, DamagedFileError] = {}
    for file in checkpoints(folder):
        try:
            checkpoint = _read(file)
        except DamagedFileError as error:
            damaged[file] = error
            continue
        try:
            _restore(file, checkpoint, algorithm)
        except ValueError as error:
            raise ValueError(f"{error} {ANEW}") from error
        _set_aside(damaged, file, len(checkpoint["episodes"]))
        return checkpoint["episodes"]
    reasons = " ".join(map(str, damaged.values())) or f"{folder} holds no checkpoint to go on from."
    raise ValueError(f"{reasons} {ANEW}")


def _read(file: Path) -> dict[str, Any]:
    """The content of a checkpoint of any format."""
    checkpoint = load_tensors(file)
    if not {"format", "episodes", "state"} <= checkpoint.keys():
        raise DamagedFileError(
            f"{file} is damaged, or no checkpoint: it holds {', '.join(map(str, checkpoint)) or 'nothing'}."
        )
    return checkpoint


def _restore(file: Path, checkpoint: dict[str, Any], algorithm: "ReinforcementTwinning") -> None:
    """Put an algorithm that was built with the same configuration into the state of a checkpoint."""
    if checkpoint["format"] != FORMAT:
        raise ValueError(f"{file} has checkpoint format {checkpoint['format']}; this version reads format {FORMAT}.")
    name, state = algorithm.twin.plant.name, checkpoint["state"]
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


def _set_aside(damaged: dict[Path, DamagedFileError], sound: Path, episodes: int) -> None:
    """Say which checkpoint was taken in the place of damaged ones, and keep these under another name."""
    for file, error in damaged.items():
        aside = file.with_name(f"{file.name}.damaged")
        file.replace(aside)
        print(f"{error} It is now {aside.name}; the training goes on from {sound.name}, after {episodes} episodes.")


RESULTS = ("metrics.json", "weights.pt")
WRITTEN = (*RESULTS, FILE)
"""Files that say that a folder holds a run."""


class RunFolder:
    """A folder in which no other training writes as long as this object holds it.

    The operating system releases the folder when the process ends, however it ends.

    Args:
        config: options of the run.
        plant: name of the run's plant.
        controllers: numbers of its classical controllers, by their names.

    Raises:
        ValueError: if the folder cannot be written or is in use; if it holds a run and ``resume`` is not asked for; if
            it is to be resumed and holds no run with these options and controllers.
    """

    def __init__(self, config: RunConfig, plant: str, controllers: Mapping[str, Any] | None = None):
        self._config, self._plant, self._controllers = config, plant, controllers or {}
        self.path = self._make_path()
        # The lock belongs to no thread, because a run may be made in one thread and trained in another.
        self._lock = filelock.FileLock(self.path / ".lock", thread_local=False)
        self.hold()
        try:
            self._require_consistent()
        except BaseException:
            self.release()
            raise

    def _make_path(self) -> Path:
        parent = Path("runs") / self._plant
        make_folder("log_dir", self._config.log_dir or parent)
        return self._config.log_dir or new_folder(parent, f"-seed-{self._config.seed}")

    def hold(self) -> None:
        """Keep other trainings out of the folder from now on.

        Raises:
            ValueError: if another training uses the folder, or it cannot be locked.
        """
        if self._lock.is_locked:
            return
        try:
            self._lock.acquire(timeout=0)
        except filelock.Timeout as error:
            raise ValueError(
                f"log_dir={self.path} is in use by another training; wait for its end, or choose another folder."
            ) from error
        except OSError as error:
            raise ValueError(f"log_dir={self.path} cannot be locked ({error}); choose another folder.") from error
        remove_partials(self.path)
        remove_partials(self.path / "figures")

    def release(self) -> None:
        """Let other trainings use the folder."""
        self._lock.release(force=True)

    def _require_consistent(self) -> None:
        if not self._config.resume:
            if checkpoints(self.path) or any((self.path / name).exists() for name in RESULTS):
                raise ValueError(f"log_dir={self.path} holds a run already; --resume it, or choose another folder.")
            if self.holds_run():
                read_settings(self.path)  # which refuses a file of somebody else that would be overwritten
            return
        if not self.holds_run():
            raise ValueError(f"log_dir={self.path} holds no run to resume: it has no {FILE}. Start without --resume.")
        require_same(self.path, self._config, self._controllers)
        if not checkpoints(self.path) and any((self.path / name).exists() for name in RESULTS):
            raise ValueError(
                f"log_dir={self.path} holds a finished run without a checkpoint: there is nothing to go on with. {ANEW}"
            )

    def resumes(self) -> bool:
        """Whether to go on from a checkpoint; a run that has none yet starts from its beginning."""
        resumable = bool(checkpoints(self.path))
        if self._config.resume and not resumable:
            print(f"The run in {self.path} has no episode done yet: it starts from its beginning.")
        return self._config.resume and resumable

    def holds_run(self) -> bool:
        """Whether the folder holds a run: its options are written when it begins."""
        return (self.path / FILE).is_file()

    def begin(self, effective: RunConfig) -> None:
        """Write ``config.json``.

        Args:
            effective: options that the run carries out.

        Raises:
            OSError: if the folder cannot be written.
        """
        write_settings(self.path, self._config, effective, self._plant, self._controllers)
