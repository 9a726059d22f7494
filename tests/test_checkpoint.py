"""Checkpoints: what they hold, what a damaged one does, and a run that has none yet."""

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from linear_quadratic import LinearQuadratic
from small_runs import SMALL, small_run

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.plants.signal import Signal
from rt_torchrl.runs import checkpoint
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.tensor_file import load_tensors, plain, save_tensors

QUICK = {"figures": False, "untrained": 0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of two episodes."""
    path = tmp_path_factory.mktemp("run")
    small_run(path, episodes=2, **QUICK).train()
    return path


def test_a_checkpoint_holds_tensors_in_plain_containers(folder):
    found = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert plain(found).keys() == {"format", "episodes", "state"} and len(found["episodes"]) == 2
    assert (
        found["state"]["algorithm"]["learner"]["memory"]["count"] == 40
    )  # two episodes of 20 transitions, none of the 460 free places


def test_the_memory_samples_the_same_after_it_was_restored(folder, tmp_path):
    runs = [small_run(tmp_path / name, episodes=2, **QUICK) for name in ("one", "other")]
    for run in runs:
        checkpoint.load(folder / "checkpoint.pt", run.algorithm)
    one, other = (run.algorithm.learner.memory for run in runs)
    assert len(one) == len(other) == 40
    for _ in range(3):
        batches = [memory.sample(16) for memory in (one, other)]
        for key in batches[0].keys(True, True):
            assert torch.equal(batches[0][key], batches[1][key])
        for memory, batch in zip((one, other), batches, strict=True):
            memory.refresh(batch["index"], batch["next", "reward"].squeeze(-1))


def test_a_damaged_checkpoint_is_told_by_its_name_and_what_to_do(folder, tmp_path):
    whole, generator = (folder / "checkpoint.pt").read_bytes(), np.random.default_rng(1)
    (tmp_path / "config.json").write_bytes((folder / "config.json").read_bytes())
    before = (tmp_path / "config.json").read_bytes()
    for length in generator.integers(0, len(whole), 5):
        (tmp_path / "checkpoint.pt").write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"checkpoint\.pt is damaged.*train anew in this folder, use --overwrite"):
            small_run(tmp_path, resume=True, **QUICK)
    middle = bytearray(whole)
    middle[whole.index(b"PK\x03\x04", len(whole) // 2) - 100] ^= 1  # within a tensor: parts follow each other
    (tmp_path / "checkpoint.pt").write_bytes(bytes(middle))
    with pytest.raises(ValueError, match=r"checkpoint\.pt is damaged"):
        small_run(tmp_path, resume=True, **QUICK)
    assert (tmp_path / "config.json").read_bytes() == before


def stale(_):
    raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))  # as a read in an open file does, without a name


def without_memory(_):
    raise MemoryError


def without_memory_for_a_tensor(*_, **__):
    torch.empty(2**57)


@pytest.mark.parametrize(
    ("where", "failing", "said"),
    [
        ((Path, "read_bytes"), stale, os.strerror(errno.ESTALE)),
        ((Path, "read_bytes"), without_memory, os.strerror(errno.ENOMEM)),
        ((torch, "load"), without_memory_for_a_tensor, os.strerror(errno.ENOMEM)),
    ],
)
def test_a_checkpoint_that_cannot_be_read_is_not_taken_for_a_damaged_one(
    where, failing, said, folder, tmp_path, monkeypatch
):
    """The earlier checkpoint would be sound: a training that took it would fly an episode again."""
    algorithm = small_run(tmp_path / "run", **QUICK).algorithm
    for name in ("checkpoint.pt", "checkpoint-0001.pt"):
        (tmp_path / name).write_bytes((folder / "checkpoint.pt").read_bytes())
    with monkeypatch.context() as patched:
        patched.setattr(*where, failing)
        with pytest.raises(OSError, match=rf"{said}.*not changed.*checkpoint\.pt"):
            checkpoint.load(tmp_path / "checkpoint.pt", algorithm)
    assert sorted(path.name for path in tmp_path.glob("check*")) == ["checkpoint-0001.pt", "checkpoint.pt"]
    assert len(checkpoint.load(tmp_path / "checkpoint.pt", algorithm)) == 2


@pytest.mark.parametrize("part", ["policies", "learner", "short_term", "virtual", "referee", "env"])
def test_a_checkpoint_without_a_part_does_not_fit(folder, tmp_path, part):
    found = load_tensors(folder / "checkpoint.pt")
    del found["state"]["algorithm"][part]
    save_tensors(tmp_path / "checkpoint.pt", found)
    algorithm = small_run(tmp_path / "run", **QUICK).algorithm
    with pytest.raises(ValueError, match=f"weights do not fit this training.*{part}"):
        checkpoint.load(tmp_path / "checkpoint.pt", algorithm)


def test_a_checkpoint_of_another_format_is_refused(folder, tmp_path):
    save_tensors(tmp_path / "checkpoint.pt", load_tensors(folder / "checkpoint.pt") | {"format": 2})
    with pytest.raises(ValueError, match="checkpoint.pt has checkpoint format 2; this version reads format 4"):
        checkpoint.load(tmp_path / "checkpoint.pt", small_run(tmp_path / "run", **QUICK).algorithm)


def test_a_plant_that_is_made_otherwise_does_not_fit(tmp_path):
    """The plant's arguments are not options of the run, so only the weights show them."""
    small_run(tmp_path, episodes=1, model_free_policy="mlp", hidden=(4,), **QUICK).train()
    config = json.loads((tmp_path / "config.json").read_text())

    class Observant(LinearQuadratic):
        observations = (*LinearQuadratic.observations, Signal(symbol="e", name="again", unit="m"))

        def observe(self, t, state, exogenous):
            return torch.cat([state, state[..., :1]], -1)

        def make_policy(self, generator):
            policy = super().make_policy(generator)
            policy.gain = torch.nn.Parameter(torch.zeros(1, 3, dtype=torch.float64))
            return policy

    options = {"compiled": False, "unseen": 3, "twinning": SMALL, "model_free_policy": "mlp", "hidden": (4,)}
    with pytest.raises(ValueError, match="weights do not fit"):
        Run(RunConfig(log_dir=tmp_path, resume=True, **options), Observant(horizon=2.0))
    assert json.loads((tmp_path / "config.json").read_text()) == config


def test_a_run_without_an_episode_is_resumed_from_its_beginning(tmp_path, monkeypatch, capsys):
    def killed(self):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(ReinforcementTwinning, "plan", killed)
        with pytest.raises(SystemExit, match="interrupted before the first episode was done"):
            small_run(tmp_path, episodes=1, **QUICK).train()
    with pytest.raises(ValueError, match="holds a run already.*--resume it, or --overwrite it"):
        small_run(tmp_path, episodes=1, **QUICK)
    resumed = small_run(tmp_path, episodes=1, resume=True, **QUICK).train()
    assert "has no episode done yet: it starts from its beginning" in capsys.readouterr().out
    whole = small_run(tmp_path / "whole", episodes=1, **QUICK).train()
    for record in (*resumed["episodes"], *whole["episodes"]):
        record["seconds"] = None
    assert resumed["episodes"] == whole["episodes"]


def test_a_run_with_a_second_training_in_its_folder_is_refused(tmp_path):
    first = small_run(tmp_path, episodes=1, **QUICK)
    assert first.folder == tmp_path
    with pytest.raises(ValueError, match="is in use by another training"):
        small_run(tmp_path, episodes=1, overwrite=True, **QUICK)
