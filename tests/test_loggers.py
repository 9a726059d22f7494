"""Weights & Biases and MLflow beside TensorBoard, without a network: what they are told is read back."""

import struct

import pytest
from linear_quadratic import LinearQuadratic
from small_runs import SMALL

from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig

BLOCK = 2**15
REAL = "cost/real episode (live policy)"


def trained(folder, logger):
    config = RunConfig(
        episodes=2, log_dir=folder, unseen=3, untrained=0, figures=False, loggers=(logger,), twinning=SMALL
    )
    metrics = Run(config, LinearQuadratic(horizon=2.0)).train()
    return [episode["real_cost"] for episode in metrics["episodes"]]


def content(log):
    """The records of a file of Weights & Biases: a header of 7 bytes, then LevelDB's log, in blocks of 32 KiB."""
    place, found = 7, b""
    while place + 7 <= len(log):
        left = BLOCK - place % BLOCK
        if left < 7:  # no room for the head of a chunk: check sum, length and kind
            place += left
            continue
        (length,) = struct.unpack("<H", log[place + 4 : place + 6])
        found += log[place + 7 : place + 7 + length]
        place += 7 + length
    return found


def test_weights_and_biases_has_the_curves_and_the_options(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb", reason="needs wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    costs = trained(tmp_path / "run", "wandb")
    assert wandb.run is None  # so that the next run of this process begins another one
    wandb.teardown()  # as at the end of the process, which writes the last block
    (file,) = (tmp_path / "run").rglob("*.wandb")
    written = content(file.read_bytes())
    for said in (REAL, "twinning.virtual_episodes", *map(repr, costs)):
        assert said.encode() in written, said


def test_mlflow_has_the_curves_and_the_options(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow", reason="needs mlflow")
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    costs = trained(tmp_path / "run", "mlflow")
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'run' / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("linear_quadratic")
    (run,) = client.search_runs([experiment.experiment_id])
    name = "cost/real episode live policy"  # MLflow takes no brackets
    assert [point.value for point in client.get_metric_history(run.info.run_id, name)] == pytest.approx(costs)
    assert run.data.params["twinning.virtual_episodes"] == "2" and run.info.status == "FINISHED"
    assert mlflow.active_run() is None
