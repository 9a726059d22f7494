"""The folder of a run: its lock, its checkpoints, and its files of tensors, whose damage is noticed."""

import io
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
        ValueError: if the file is damaged, or holds any object that is not a tensor or a plain container; such an
            object is not built.
        OSError: if the file cannot be read.
    """
    file = path.read_bytes()
    try:
        with zipfile.ZipFile(io.BytesIO(file)) as archive:
            if (wrong := archive.testzip()) is not None:
                raise ValueError(f"{wrong} does not have the checksum it was written with")
        content = torch.load(io.BytesIO(file), weights_only=True, map_location="cpu")
        if not isinstance(content, dict):
            raise ValueError(f"it holds a {type(content).__name__}")
    except MemoryError:
        raise
    except Exception as error:  # of many kinds; torch adds advice after the first line, such as to run the code in it
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{path} is damaged, or no file of a run of this version: {reason}.") from error
    return content


def plain(value: Any, place: str = "") -> Any:
    """The value with only Python's own containers and numbers, and with plain tensors on the CPU.

    Raises:
        ValueError: if it holds anything but tensors, numbers and strings; it names the place.
    """
    if isinstance(value, torch.Tensor):
        # torch.save writes the whole storage of a tensor, of which a slice of a rollout is a small part.
        return value.detach().cpu().as_subclass(torch.Tensor).clone()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {key: plain(entry, f"{place}[{key!r}]") for key, entry in value.items()}
    if isinstance(value, list | tuple):
        entries = [plain(entry, f"{place}[{k}]") for k, entry in enumerate(value)]
        return entries if isinstance(value, list) else tuple(entries)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ValueError(
        f"{place or 'content'} of what is to be saved is a {type(value).__name__}; a state_dict may hold tensors, "
        "numbers and strings, in dicts, lists and tuples."
    )


FORMAT = 8
KEPT = 3
"""Number of latest checkpoints that are kept."""
ANEW = "To train anew, choose another folder."


def save_checkpoint(folder: Path, algorithm: "ReinforcementTwinning", episodes: list[dict[str, Any]]) -> None:
    """Write a checkpoint, whose name has the number of episodes; earlier ones stay until it is complete.

    Args:
        folder: run folder.
        algorithm: algorithm to save.
        episodes: records of the episodes that are done.

    Raises:
        ValueError: if a component's state, such as an environment's, holds more than tensors, numbers and strings.
        OSError: if the checkpoint cannot be written.
    """
    state = {"plant": algorithm.twin.plant.name, "algorithm": algorithm.state_dict()}
    content = {"format": FORMAT, "episodes": episodes, "state": state}
    save_tensors(folder / f"checkpoint-{len(episodes):04d}.pt", content)
    for old in checkpoints(folder)[KEPT:]:
        old.unlink(missing_ok=True)


def checkpoints(folder: Path) -> list[Path]:
    """The checkpoints of a run, latest first."""
    return sorted(folder.glob("checkpoint-[0-9]*.pt"), key=lambda file: (len(file.name), file.name), reverse=True)


def load_checkpoint(folder: Path, algorithm: "ReinforcementTwinning") -> list[dict[str, Any]]:
    """Put an algorithm into the state of the newest checkpoint, and return the records of its episodes.

    Args:
        folder: run folder.
        algorithm: algorithm that was built with the same configuration.

    Raises:
        ValueError: if there is no checkpoint, or the newest is damaged, has another format, belongs to another plant,
            or does not fit.
    """
    file = next(iter(checkpoints(folder)), None)
    if file is None:
        raise ValueError(f"{folder} holds no checkpoint to go on from. {ANEW}")
    try:
        checkpoint = load_tensors(file)
    except ValueError as error:
        raise ValueError(f"{error} Remove it to go on from the checkpoint before it. {ANEW}") from error
    if checkpoint.get("format") != FORMAT:
        raise ValueError(
            f"{file} has checkpoint format {checkpoint.get('format')}; this version reads format {FORMAT}. {ANEW}"
        )
    name, state = algorithm.twin.plant.name, checkpoint["state"]
    if state["plant"] != name:
        raise ValueError(f"{file} is of plant {state['plant']!r}, this training of {name!r}; use its recipe. {ANEW}")
    try:
        algorithm.load_state_dict(state["algorithm"])
    except (KeyError, ValueError) as error:
        raise ValueError(
            f"the weights of {file} do not fit this training of {name!r}; start with the options it was started "
            f"with (see its config.json). {type(error).__name__}: {error} {ANEW}"
        ) from error
    return checkpoint["episodes"]


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
        parent = Path("runs") / plant
        make_folder("log_dir", config.log_dir or parent)
        self.path = config.log_dir or new_folder(parent, f"-seed-{config.seed}")
        # The lock belongs to no thread, because a run may be made in one thread and trained in another.
        self._lock = filelock.FileLock(self.path / ".lock", thread_local=False)
        self.hold()
        try:
            self._require_consistent()
        except BaseException:
            self.release()
            raise

    def hold(self) -> None:
        """Keep other trainings out of the folder from now on.

        Raises:
            ValueError: if another training uses the folder, or it cannot be locked.
        """
        if self._lock.is_locked:
            return
        try:
            self._lock.acquire(timeout=0)
        except (filelock.Timeout, OSError) as error:
            raise ValueError(
                f"log_dir={self.path} is in use by another training, or cannot be locked ({error}); wait for its end, "
                "or choose another folder."
            ) from error
        for folder in (self.path, self.path / "figures"):
            remove_partials(folder)

    def release(self) -> None:
        """Let other trainings use the folder."""
        self._lock.release(force=True)

    def _require_consistent(self) -> None:
        holds_run = (self.path / FILE).is_file()
        finished = any((self.path / name).exists() for name in RESULTS)
        if not self._config.resume:
            if checkpoints(self.path) or finished:
                raise ValueError(f"log_dir={self.path} holds a run already; --resume it, or choose another folder.")
            if holds_run:
                read_settings(self.path)  # which refuses a file of somebody else that would be overwritten
            return
        if holds_run:
            require_same(self.path, self._config, self._controllers)
        if not holds_run or (finished and not checkpoints(self.path)):
            raise ValueError(f"log_dir={self.path} holds no run to resume: it needs {FILE} and a checkpoint. {ANEW}")

    def begin(self, effective: RunConfig) -> None:
        """Write ``config.json``.

        Args:
            effective: options that the run carries out.

        Raises:
            OSError: if the folder cannot be written.
        """
        write_settings(self.path, self._config, effective, self._plant, self._controllers)
