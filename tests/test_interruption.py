"""Ctrl-C: at any moment of a training nothing is lost but the episode under way."""

import contextlib
import dataclasses
import json
import os
import signal
import threading
import time

import pytest
from small_runs import small_run

from rt_torchrl.interruption import Interruption, safe_point
from rt_torchrl.steps.learn import ActorCritic

EPISODES = 4
QUICK = {"figures": False}


def press():
    os.kill(os.getpid(), signal.SIGINT)


@contextlib.contextmanager
def pressed_after(seconds):
    """Press Ctrl-C after this time, whatever is under way."""
    before = signal.signal(signal.SIGALRM, lambda number, frame: press())
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


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


def test_a_handler_of_somebody_else_stays(capfd):
    pressed = []
    before = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))
    try:
        with Interruption():
            press()
            safe_point()
        assert pressed == [signal.SIGINT]
    finally:
        signal.signal(signal.SIGINT, before)
    assert "interrupted" not in capfd.readouterr().err


def deterministic(episodes):
    return [{**record, "seconds": None} for record in episodes]


def require_nothing_lost(folder, whole, seconds):
    """Require that a training which is interrupted at this time and resumed has the episodes of one that is not."""
    found = None
    try:
        run = small_run(folder, episodes=EPISODES, **QUICK)
        with pressed_after(seconds):
            found = run.train()
    except (KeyboardInterrupt, SystemExit):
        # The interrupt may come just after the results were written; half-written ones are never there.
        found = json.loads(path.read_text()) if (path := folder / "metrics.json").exists() else None
    if found is not None:
        # What was done before the interrupt is there, judged and saved.
        assert json.loads((folder / "metrics.json").read_text()) == found and (folder / "weights.pt").exists()
        assert deterministic(found["episodes"]) == whole[: len(found["episodes"])]
    # A training that was interrupted before it began has left no options to resume with.
    begun = (folder / "config.json").exists()
    resumed = small_run(folder, episodes=EPISODES, resume=begun, **QUICK).train()
    assert deterministic(resumed["episodes"]) == whole
    return found and len(found["episodes"])


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A training that is not interrupted, and how long it takes once its programs are there [s]."""
    small_run(tmp_path_factory.mktemp("first"), episodes=1, **QUICK).train()
    run = small_run(tmp_path_factory.mktemp("whole"), episodes=EPISODES, **QUICK)
    begin = time.perf_counter()
    found = run.train()
    return deterministic(found["episodes"]), time.perf_counter() - begin


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_an_interrupt_loses_nothing_but_the_episode_under_way(tmp_path, trained, share):
    whole, seconds = trained
    require_nothing_lost(tmp_path, whole, share * seconds)


def test_an_interrupt_stops_within_an_iteration(tmp_path, monkeypatch):
    """Step 2 iterates without an end here, and TorchRL has swapped weights for most of its time."""
    small = small_run(tmp_path, episodes=2, **QUICK)
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


def test_a_second_interrupt_leaves_at_once_whatever_became_of_it(tmp_path, monkeypatch, capsys):
    run = small_run(tmp_path, episodes=3, **QUICK)
    run_one = run.algorithm.episode

    def interrupted(tell):
        if run.episodes:
            press()
            try:
                press()
                time.sleep(1)
            except KeyboardInterrupt:
                raise RuntimeError("Converting a tensordict to boolean value is not permitted") from None
        return run_one(tell)

    monkeypatch.setattr(run.algorithm, "episode", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run.train()
    assert "1 episodes done are in" in capsys.readouterr().out
    assert len(small_run(tmp_path, episodes=2, resume=True, **QUICK).train()["episodes"]) == 2
