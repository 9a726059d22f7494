"""Ctrl-C: at any moment of a training nothing is lost but the episode under way."""

import dataclasses
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
