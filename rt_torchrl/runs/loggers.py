"""Loggers of TorchRL beside TensorBoard, for those who keep their runs in another place."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rt_torchrl.runs.mlflow_logger import MLflowLogger

if TYPE_CHECKING:
    from torchrl.record.loggers import Logger  # only its type: it loads TorchRL

LoggerName = Literal["csv", "wandb", "mlflow"]
PACKAGES: dict[LoggerName, str] = {"wandb": "wandb", "mlflow": "mlflow"}
"""Package that a logger needs."""


def require_loggers(names: Sequence[LoggerName]) -> None:
    """Refuse loggers that lack their package, before any work.

    Raises:
        ValueError: if there is one; it says what to install.
    """
    for name in names:
        package = PACKAGES.get(name)
        if package and importlib.util.find_spec(package) is None:
            raise ValueError(f"loggers={name!r} needs a package that is not installed: pip install {package}.")


def make_loggers(names: Sequence[LoggerName], folder: Path, plant: str) -> "list[Logger | MLflowLogger]":
    """The loggers of a run.

    Args:
        names: which ones.
        folder: run folder; the run has its name, and CSV files go to ``csv/`` in it.
        plant: name of the plant, which is the project of W&B and the experiment of MLflow.
    """
    if not names:
        return []
    from torchrl.record.loggers import get_logger

    here = str(folder)
    places = {"csv": (here, "csv"), "wandb": (here, folder.name)}
    options: dict[str, Any] = {"wandb_kwargs": {"project": f"rt_torchrl {plant}"}}
    return [
        MLflowLogger(folder, plant) if name == "mlflow" else get_logger(name, *places[name], **options)
        for name in names
    ]
