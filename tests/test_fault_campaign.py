"""The campaign of faults: trainings that are stopped, damaged checkpoints, full disks.

`uv run --group test pytest -m faults` runs all of it, and the other suites its first tests of each kind. Trainings run
in processes that a clean server forks, so that each of them takes a second.
"""

import errno
import functools
import multiprocessing
import os
import pickle
import random
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from fault_victim import EPISODES, QUICK, SHIPPED, victim
from small_runs import small_run
from test_run_folder import Bomb

from rt_torchrl.runs import run_folder
from rt_torchrl.runs.run_folder import load_tensors, plain, save_tensors
from rt_torchrl.steps.belief import equal

pytestmark = pytest.mark.training

LATER = ("sklearn.svm", "scipy.interpolate", "torch.utils.tensorboard", "rt_torchrl.trajectories.engines.native")
"""What a training imports when it first needs it."""


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A server of processes that has imported everything, and forks a clean process for each training."""
    with pytest.MonkeyPatch.context() as patched:
        # The server looks for what it loads in advance where Python itself looks.
        here, before = str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")
        patched.setenv("PYTHONPATH", os.pathsep.join(filter(None, (here, before))))
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["fault_victim", *LATER])
        started(context, tmp_path_factory.mktemp("first")).join()  # starts the server, and fills the cache of programs
        yield context


@pytest.fixture(scope="module")
def whole(tmp_path_factory, server):
    """Trainings that nothing disturbs, by plant: folder and episodes of each, and how long it takes [s]."""

    @functools.cache
    def run(plant):
        folder, begin = tmp_path_factory.mktemp("whole"), time.perf_counter()
        started(server, folder, plant).join()
        return folder, deterministic(folder), time.perf_counter() - begin

    return run


def started(server, folder, plant=None, kill_at=None, **options):
    process = server.Process(target=victim, args=(folder, options, kill_at, plant))
    process.start()
    return process


def deterministic(folder):
    """The episodes of a run's checkpoint, without what depends on the clock."""
    return [{**record, "seconds": None} for record in load_tensors(run_folder.checkpoints(folder)[0])["episodes"]]


def require_resumed(server, folder, undisturbed, plant=None, **options):
    """The rest of the training: as if nothing had happened, to the bit, in its episodes and in its weights."""
    begun = (folder / "config.json").exists()
    process = started(server, folder, plant, resume=begun, **options)
    process.join()
    assert process.exitcode == 0 and deterministic(folder) == undisturbed[1]
    assert not list(folder.glob(".*.partial"))
    assert equal(*(load_tensors(path / "weights.pt") for path in (folder, undisturbed[0])))


STOPS = [("kill", None, 40), ("terminate", None, 20)]
STOPS += [("kill", plant, 2) for plant in SHIPPED]


@pytest.mark.parametrize(
    ("stop", "plant", "number"),
    [
        pytest.param(*stop, number, marks=pytest.mark.faults if number or stop[1] else pytest.mark.slow)
        for *stop, count in STOPS
        for number in range(count)
    ],
)
def test_a_training_that_is_stopped_at_any_moment_goes_on_to_the_bit(server, tmp_path, whole, stop, plant, number):
    """It loses at most the episode under way."""
    undisturbed = whole(plant)
    process = started(server, tmp_path, plant)
    time.sleep(random.Random(f"{stop} {number}").uniform(0.05, 1.0) * undisturbed[2])
    getattr(process, stop)()
    process.join()
    require_resumed(server, tmp_path, undisturbed, plant)


@pytest.mark.faults
@pytest.mark.parametrize("number", range(12))
def test_a_kill_inside_a_write_loses_nothing(server, tmp_path, whole, number):
    process = started(server, tmp_path, kill_at=number % 8)
    process.join()
    assert process.exitcode in (-signal.SIGKILL, 0)
    require_resumed(server, tmp_path, whole(None))


def test_sigterm_ends_a_training_with_its_results(tmp_path, monkeypatch):
    """As Ctrl-C: what was done before is judged and saved."""
    run = small_run(tmp_path, episodes=EPISODES, **QUICK)
    run_one = run.algorithm.episode

    def terminated(tell):
        if len(run.episodes) == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return run_one(tell)

    monkeypatch.setattr(run.algorithm, "episode", terminated)
    assert len(run.train()["episodes"]) == 2 and (tmp_path / "weights.pt").exists()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def broken(whole, number, trace):
    """A damaged or foreign checkpoint of one of six kinds."""
    generator, file = np.random.default_rng(number), trace.with_suffix(".pt")
    place = int(generator.integers(0, len(whole)))
    match number % 6:
        case 0:  # a flipped bit or some
            damaged = bytearray(whole)
            for place in generator.integers(0, len(whole), 1 + number % 3):
                damaged[place] ^= 1 << int(generator.integers(8))
            return bytes(damaged)
        case 1:
            return whole[:place]
        case 2:  # a page that a power cut has lost
            return whole[:place] + bytes(min(4096, len(whole) - place)) + whole[place + 4096 :]
        case 3:
            return pickle.dumps({"format": Bomb(trace)})
        case 4:
            save_tensors(file, {"weights": torch.zeros(3)})
            return file.read_bytes()
    return whole[: len(whole) // 2] + generator.bytes(100) + whole[len(whole) // 2 :]


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A run of which three checkpoints are kept, with the states in them."""
    folder = tmp_path_factory.mktemp("kept")
    small_run(folder, episodes=EPISODES, **QUICK).train()
    files = run_folder.checkpoints(folder)
    assert [file.name for file in files] == [f"checkpoint-000{k}.pt" for k in (5, 4, 3)]
    return files, [load_tensors(file)["state"]["algorithm"] for file in files]


@pytest.mark.parametrize("numbers", [range(6), pytest.param(range(6, 240), marks=pytest.mark.faults)])
def test_a_damaged_checkpoint_is_refused_and_the_one_before_goes_on(kept, numbers, tmp_path):
    (files, states), trace = kept, tmp_path / "trace"
    newest, before = (tmp_path / file.name for file in files[:2])
    algorithm = small_run(tmp_path / "run", episodes=EPISODES, **QUICK).algorithm
    before.write_bytes(files[1].read_bytes())
    for number in numbers:
        newest.write_bytes(broken(files[0].read_bytes(), number, trace))
        refusal = ""
        try:
            run_folder.load_checkpoint(tmp_path, algorithm)
        except ValueError as error:
            refusal = str(error)
        if refusal:
            assert newest.name in refusal and "choose another folder" in refusal
            newest.unlink()
            assert len(run_folder.load_checkpoint(tmp_path, algorithm)) == EPISODES - 1
        # Damage may have no effect on the content.
        assert equal(plain(algorithm.state_dict()), states[bool(refusal)])
        assert not trace.exists()


def test_from_an_earlier_checkpoint_the_training_is_the_same_to_the_bit(tmp_path, kept):
    whole, again = kept[0][0].parent, tmp_path / "again"
    shutil.copytree(whole, again, ignore=shutil.ignore_patterns("w*", "checkpoint-0005.pt", "checkpoint-0004.pt"))
    small_run(again, episodes=EPISODES, resume=True, **QUICK).train()
    assert deterministic(again) == deterministic(whole)
    assert equal(*(load_tensors(folder / "weights.pt") for folder in (again, whole)))


def test_a_full_disk_stops_with_what_was_done_saved_and_says_so(tmp_path, monkeypatch, capsys):
    """The disk is full after the options and three checkpoints, with their folders."""
    small_run(tmp_path / "whole", episodes=4, **QUICK).train()
    run = small_run(tmp_path / "run", episodes=4, **QUICK)
    left, sync = [2 * 4], os.fsync

    def full(descriptor):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(descriptor)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            run.train()
    said = f"stopped: 3 episodes done are in {tmp_path / 'run'}; --resume goes on with them"
    assert said in capsys.readouterr().out
    assert deterministic(tmp_path / "run") == deterministic(tmp_path / "whole")[:3]
    small_run(tmp_path / "run", episodes=4, resume=True, **QUICK).train()
    assert deterministic(tmp_path / "run") == deterministic(tmp_path / "whole")
