"""The folder of one run, in which one training at a time writes and an earlier run may have left files."""

import os
from pathlib import Path

import filelock

from rt_torchrl.atomic_file import remove_partials
from rt_torchrl.runs import checkpoint, run_settings
from rt_torchrl.runs.results_file import new_folder
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.settings import FILE

RESULTS = ("metrics.json", "weights.pt")
WRITTEN = ("metrics.json", "weights.pt", "checkpoint.pt", "config.json")
LEFT = (
    *("events.out.tfevents.*", "csv/scalars/**/*.csv", "csv/texts/*.txt"),
    *("figures/*.png", "figures/animation.gif"),
    *("checkpoint-*.pt", "checkpoint*.pt.damaged"),
    *WRITTEN,
)
"""Files of a run, in the order of their removal: ``config.json`` comes last, because it tells what the others are."""


class RunFolder:
    """A folder in which no other training writes as long as this object holds it.

    The operating system releases the folder when the process ends, however it ends.

    Args:
        config: options of the run.
        plant: name of the run's plant.

    Raises:
        ValueError: if the folder cannot be written or is in use; if it holds a run and neither ``resume`` nor
            ``overwrite`` is asked for; if it is to be resumed and holds no run with these options.
    """

    def __init__(self, config: RunConfig, plant: str):
        if config.resume and config.overwrite:
            raise ValueError(
                "resume and overwrite exclude each other: one goes on with the run in log_dir, the other removes it."
            )
        self._config, self._plant = config, plant
        self.path = self._writable()
        # The lock belongs to no thread, because a run may be made in one thread and trained in another.
        self._lock = filelock.FileLock(self.path / ".lock", thread_local=False)
        self.hold()
        try:
            self._require_own()
        except BaseException:
            self.release()
            raise

    def _writable(self) -> Path:
        parent = Path("runs") / self._plant
        path = self._config.log_dir or parent
        try:
            if self._config.log_dir is None:
                path = new_folder(parent, f"-seed-{self._config.seed}")
            path.mkdir(parents=True, exist_ok=True)
            probe = path / f".writable-{os.getpid()}"
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise ValueError(f"log_dir={path} cannot be written ({error}); choose another with --log-dir.") from error
        return path

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

    def _require_own(self) -> None:
        config, path = self._config, self.path
        if config.resume:
            self._require_resumable()
        elif not config.overwrite and any((path / name).exists() for name in WRITTEN):
            raise ValueError(
                f"log_dir={path} holds a run already; choose another folder, or --resume it, or --overwrite it."
            )

    def _require_resumable(self) -> None:
        if not self.begun():
            raise ValueError(f"log_dir={self.path} holds no run to resume: it has no {FILE}. Start without --resume.")
        run_settings.require_same(self.path, self._config)
        if not checkpoint.exists(self.checkpoint) and any((self.path / name).exists() for name in RESULTS):
            raise ValueError(
                f"log_dir={self.path} holds a finished run without its {self.checkpoint.name}: there is nothing to go "
                "on with. To train anew in this folder, use --overwrite."
            )

    @property
    def checkpoint(self) -> Path:
        """Path of the newest checkpoint, whether or not it exists yet."""
        return self.path / checkpoint.NAME

    def resumes(self) -> bool:
        """Whether to go on from a checkpoint; a run that has none yet starts from its beginning."""
        there = checkpoint.exists(self.checkpoint)
        if self._config.resume and not there:
            print(f"The run in {self.path} has no episode done yet: it starts from its beginning.")
        return self._config.resume and there

    def begun(self) -> bool:
        """Whether the folder holds a run: its options are written when it begins."""
        return (self.path / FILE).is_file()

    def begin(self, effective: RunConfig) -> None:
        """Remove the files that are to be overwritten, then write ``config.json``.

        In this order the results of one run never lie beside the options of another.

        Args:
            effective: options that the run carries out.

        Raises:
            OSError: if the folder cannot be written.
        """
        if self._config.overwrite:
            for pattern in LEFT:
                for old in self.path.glob(pattern):
                    old.unlink(missing_ok=True)
        run_settings.write_settings(self.path, self._config, effective, self._plant)
