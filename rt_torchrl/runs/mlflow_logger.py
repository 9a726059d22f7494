"""A logger to MLflow, by the methods of TorchRL's loggers."""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SERVER = "MLFLOW_TRACKING_URI"
"""Variable of the environment that names a server or another store."""
REFUSED = re.compile(r"[^\w\-. /:]")
"""What MLflow takes in no name."""
LONGEST = 6000
"""Greatest number of letters of an option's value that MLflow takes."""


class MLflowLogger:
    """Curves and options of one run in MLflow.

    TorchRL's own logger writes to a folder of files, which MLflow refuses since version 3, keeps its run active in the
    whole process, and passes on names that MLflow refuses. This one writes to ``mlflow.db`` in the run folder or, if it
    is set, to the store that ``MLFLOW_TRACKING_URI`` names.

    Args:
        folder: run folder, whose name the run has.
        experiment: name of the experiment.
    """

    def __init__(self, folder: Path, experiment: str):
        from mlflow import MlflowClient  # here, because only runs that ask for it need it

        store = os.environ.get(SERVER) or f"sqlite:///{(folder / 'mlflow.db').resolve()}"
        self._client = MlflowClient(store)
        found = self._client.get_experiment_by_name(experiment)
        place = self._client.create_experiment(experiment) if found is None else found.experiment_id
        self._run = self._client.create_run(place, run_name=folder.name).info.run_id

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """Write a point of a curve, whose name loses the letters that MLflow does not take."""
        self._client.log_metric(self._run, REFUSED.sub("", name), value, step=step)

    def log_hparams(self, cfg: Mapping[str, Any]) -> None:
        """Write the options of the run."""
        for name, value in cfg.items():
            self._client.log_param(self._run, REFUSED.sub("", name), str(value)[:LONGEST])

    def close(self) -> None:
        """Say that the run has ended."""
        self._client.set_terminated(self._run)
