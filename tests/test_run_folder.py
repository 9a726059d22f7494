"""A run folder and its files: who writes, what is overwritten and resumed, and damage that is noticed."""

import dataclasses
import errno
import hashlib
import json
import os
import signal
import threading
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from small_runs import small_run
from torch import nn

from rt_torchrl import OperationConfig, RunConfig
from rt_torchrl.atomic_file import write_json
from rt_torchrl.interruption import Interruption, safe_point
from rt_torchrl.options import read_options
from rt_torchrl.runs import run_folder
from rt_torchrl.runs.run_folder import RunFolder, load_tensors, save_tensors
from rt_torchrl.runs.settings import BESIDE, read_settings
from rt_torchrl.steps.belief import equal
from rt_torchrl.steps.learn import ActorCritic
from rt_torchrl.steps.plan import MultiStart


def begun(path, **options):
    """A run that has written its options."""
    config = RunConfig(log_dir=path, **options)
    folder = RunFolder(config, "p")
    folder.begin(config.effective())
    folder.release()
    return config


def contents(path):
    return {file.relative_to(path): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_a_folder_in_use_is_refused_until_it_is_let_go(tmp_path):
    (tmp_path / ".checkpoint.pt.1-ab.partial").touch()  # left by a killed writer
    folder = RunFolder(RunConfig(log_dir=tmp_path), "p")
    assert not list(tmp_path.glob(".*.partial"))
    with pytest.raises(ValueError, match="log_dir=.* is in use by another training"):
        RunFolder(RunConfig(log_dir=tmp_path), "p")
    folder.release()
    RunFolder(RunConfig(log_dir=tmp_path), "p").release()


def test_a_run_is_not_resumed_with_other_options(tmp_path):
    begun(tmp_path)
    before, default = contents(tmp_path), RunConfig().twinning
    learner = dataclasses.replace(default.learner, actor_rate=1e-3, discount=0.5)
    for options, named in (
        ({"policy": "mlp", "hidden": (4,)}, r"hidden is \[4\] here and was \[32, 32\] in the run"),
        (
            {"twinning": dataclasses.replace(default, learner=learner)},
            "actor_rate is 0.001 here and was 0.002.*learner.discount is 0.5",
        ),
    ):
        with pytest.raises(ValueError, match=named):
            RunFolder(RunConfig(log_dir=tmp_path, resume=True, **options), "p")
    assert contents(tmp_path) == before


def test_a_run_is_resumed_with_harmless_options(tmp_path):
    begun(tmp_path)
    harmless = {"episodes": 7, "figures": False, "threads": 1, "reference": True}
    config = begun(tmp_path, resume=True, unseen=3, unseen_every=2, **harmless)
    settings = read_settings(tmp_path)
    assert [set(ran) for ran in settings["ran"]] == [{"effective", "versions", "command", "time"}] * 2
    options = {name: value for name, value in settings.items() if name not in BESIDE}
    assert settings["plant"] == "p" and read_options(RunConfig, options) == config
    # From now on episodes are judged on three unseen ones; the next are not to be judged on others.
    with pytest.raises(ValueError, match="unseen is 4 here and was 3"):
        begun(tmp_path, resume=True, unseen=4)


def test_a_run_that_has_lost_its_checkpoints_is_not_resumed(tmp_path):
    begun(tmp_path)
    (tmp_path / "weights.pt").touch()
    with pytest.raises(ValueError, match="holds no run to resume: it needs config.json and a checkpoint"):
        RunFolder(RunConfig(log_dir=tmp_path, resume=True), "p")


# Files that a run writes: whole or not at all, without code, and with their damage noticed.


CONTENT = {
    "policy": {"gain": torch.linspace(0.0, 1.0, 300, dtype=torch.float64)},
    "pair": (1, 0.5),
    "names": ["model_free", None, True],
}


def test_what_is_saved_is_read_back(tmp_path):
    """Also by torch alone; weights and numbers of other kinds become plain ones."""
    file, module = tmp_path / "weights.pt", nn.Linear(2, 3)
    others = {"module": module.state_dict(), "number": np.float64(0.1), "size": torch.Size([2])}
    save_tensors(file, CONTENT | others)
    expected = CONTENT | {"module": dict(module.state_dict()), "number": 0.1, "size": (2,)}
    for found in (load_tensors(file), torch.load(file, weights_only=True)):
        assert equal(found, expected) and type(found["module"]) is dict and type(found["number"]) is float
    with pytest.raises(ValueError, match=r"\['real_system'\]\['rng'\]\[1\] of what is to be saved is a ndarray"):
        save_tensors(file, {"real_system": {"rng": [0, np.zeros(2)]}})
    assert [path.name for path in tmp_path.iterdir()] == ["weights.pt"] and equal(load_tensors(file), expected)
    save_tensors(file, {"part": torch.zeros(1_000_000)[:10]})
    assert file.stat().st_size < 10_000  # the tensor alone, without what it is a slice of


class Bomb:
    """A pickle that would make a file."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


def test_a_file_runs_no_code(tmp_path):
    """test_fault_campaign.py has a bare pickle."""
    file, trace = tmp_path / "checkpoint.pt", tmp_path / "trace"
    torch.save({"format": 4, "state": Bomb(trace)}, file)
    archive = file.read_bytes()
    seal = b"sha256:" + hashlib.sha256(archive).hexdigest().encode()
    file.write_bytes(archive[:-2] + len(seal).to_bytes(2, "little") + seal)
    with pytest.raises(ValueError, match="checkpoint.pt is damaged, or no file of a run"):
        load_tensors(file)
    assert not trace.exists()


def test_a_full_disk_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    file = tmp_path / "checkpoint.pt"
    save_tensors(file, CONTENT)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
        with pytest.raises(OSError, match="No space left on device; what was there before is intact.*checkpoint.pt"):
            save_tensors(file, {"other": 1})
    assert equal(load_tensors(file), CONTENT)
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_numbers_that_json_does_not_have_are_null(tmp_path):
    """Paths are text then, and dataclasses objects."""
    file, found = tmp_path / "metrics.json", {"a": (float("inf"), 1.0), "b": {"c": float("nan"), "d": "NaN"}}
    content = found | {"config": OperationConfig(), "folder": tmp_path}
    read = json.loads(write_json(file, content).read_text(), parse_constant=pytest.fail)
    config = {"speed": 1.0, "continuous": False}
    assert read == {"a": [None, 1.0], "b": {"c": None, "d": "NaN"}, "config": config, "folder": str(tmp_path)}


# Checkpoints: what they hold, what a damaged one does, and a run that has none yet.


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of two episodes."""
    path = tmp_path_factory.mktemp("run")
    small_run(path, episodes=2).train()
    return path


PARTS = {"learner": "learn", "short_term": "interact", "virtual": "inputs", "referee": "switch", "env": "interact"}


def test_a_checkpoint_without_a_part_or_of_another_format_does_not_fit(folder, tmp_path):
    algorithm, file = small_run(tmp_path / "run").algorithm, tmp_path / "checkpoint-0002.pt"

    def refused(changed, message):
        save_tensors(file, changed)
        with pytest.raises(ValueError, match=message):
            run_folder.load_checkpoint(tmp_path, algorithm)

    for part, step in PARTS.items():
        found = load_tensors(folder / file.name)
        del found["state"]["algorithm"][f"module.{step}._extra_state"][part]
        refused(found, f"weights of .* do not fit this training.*{part}")
    found = load_tensors(folder / file.name)
    del found["state"]["algorithm"]["model_free.gain"]
    refused(found, r"(?s)weights of .* do not fit this training.*policies.*model_free\.gain")
    refused(found | {"format": 2}, "checkpoint-0002.pt has checkpoint format 2; this version reads format 8")


def test_a_run_without_an_episode_starts_again_or_is_resumed_from_its_beginning(tmp_path, monkeypatch):
    def killed(self, episode):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(MultiStart, "forward", killed)
        for _ in range(2):  # the same command again, although the first has written the options
            with pytest.raises(SystemExit, match="interrupted before the first episode was done"):
                small_run(tmp_path, episodes=1).train()
    resumed = small_run(tmp_path, episodes=1, resume=True).train()
    whole = small_run(tmp_path / "whole", episodes=1).train()
    for record in (*resumed["episodes"], *whole["episodes"]):
        record["seconds"] = None
    assert resumed["episodes"] == whole["episodes"]
    with pytest.raises(ValueError, match="holds a run already; --resume it, or choose another folder"):
        small_run(tmp_path, episodes=1)


# Ctrl-C: at any moment of a training nothing is lost but the episode under way.


def press():
    os.kill(os.getpid(), signal.SIGINT)


def test_a_first_press_waits_for_a_safe_point_and_a_second_does_not():
    with Interruption() as interruption:
        safe_point()
        press()
        assert not interruption.at_once
        with pytest.raises(KeyboardInterrupt):
            safe_point()
        with pytest.raises(KeyboardInterrupt):
            press()
            time.sleep(1)
        assert interruption.at_once
    safe_point()  # forgotten
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_stops_within_an_iteration(tmp_path, monkeypatch):
    """Step 2 iterates without an end here, and TorchRL has swapped weights for most of its time."""
    small = small_run(tmp_path, episodes=2)
    run_one, update = small.algorithm.episode, ActorCritic.update

    def endless(self):
        self.config = dataclasses.replace(self.config, critic_iterations=10**9)
        return update(self)

    def second(tell):
        if small.episodes:
            monkeypatch.setattr(ActorCritic, "update", endless)
            threading.Timer(0.5, press).start()
        return run_one(tell)

    monkeypatch.setattr(small.algorithm, "episode", second)
    begin = time.perf_counter()
    assert len(small.train()["episodes"]) == 1
    # An endless loop is left in the time of an iteration; all else of this training takes seconds.
    assert time.perf_counter() - begin < 60
