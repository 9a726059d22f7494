"""An operation in a process of its own, with true clocks, and whole runs of it."""

import os

import pytest
import torch
from linear_quadratic import LinearQuadratic
from small_runs import small_run
from test_operation import QUIET, Constant

from rt_torchrl.runs.operated import learner_threads
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.operation.acting import Crew
from rt_torchrl.systems.operation.config import OperationConfig
from rt_torchrl.systems.operation.process import ProcessOperation
from rt_torchrl.systems.sound_part import EpisodeEndedError

PLANT = LinearQuadratic(horizon=1.0)


class Breaking(PlantEnv):
    """A system that raises in the fifth interval of its second window."""

    def _step(self, tensordict):
        if self._episodes == 2 and self._step_count.item() == 4:
            raise OSError("the sensor's cable is cut")
        return super()._step(tensordict)


def breaking():
    return Breaking(PLANT)


def simulation():
    return PlantEnv(PLANT)


def operation(make_env=simulation, **options):
    policies = {"one": Constant(0.5), "two": Constant(-0.5)}
    config = OperationConfig(clock="wall", speed=10.0, core=-2, **options)
    return ProcessOperation(Crew(make_env, PLANT, policies, QUIET, config, seed=1), make_env()), policies


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system does not let a process choose cores")
@pytest.mark.parametrize(
    "options, expected",
    [
        ({}, 0),
        ({"asynchronous": True}, 0),
        ({"asynchronous": True, "operation": OperationConfig(clock="wall")}, 2),
        ({"asynchronous": True, "operation": OperationConfig(clock="wall", core=-2)}, 0),
        ({"asynchronous": True, "operation": OperationConfig(clock="wall"), "threads": 7}, 7),
    ],
)
def test_the_learner_has_a_thread_for_each_core_that_is_left(options, expected, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {4, 5, 6})
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    assert learner_threads(RunConfig(**options)) == expected


@pytest.mark.slow
def test_a_policy_takes_over_in_the_other_process_without_a_bump():
    found, policies = operation(continuous=True)
    try:
        found.hand_over("one", policies["one"], strength=0.0)
        found.rollout()
        found.hand_over("two", policies["two"], strength=0.0)
        window = found.rollout()
        while window["version"].max() < 1:
            window = found.rollout()
        window = torch.cat([window, found.rollout()], 1)[0]
    finally:
        found.close()
    action = window["action"].flatten()
    # A range of 4 N in 20 intervals is 0.2 N an interval.
    assert action[0] == 0.5 and action[-1] == -0.5 and action.diff().abs().max() <= 0.2 + 1e-12
    assert torch.equal(window["state"][10], window["next", "state"][9])  # continuous
    assert (window["late"] >= 0.0).all() and (window["late"] > 0.0).any()


@pytest.mark.slow
def test_a_window_ends_with_the_error_of_the_real_system_and_the_operation_goes_on():
    found, policies = operation(breaking)
    try:
        found.hand_over("one", policies["one"], strength=0.0)
        assert found.rollout()["version"].eq(0).all()
        with pytest.raises(EpisodeEndedError, match="0.4 s: OSError: the sensor.s cable is cut") as raised:
            found.rollout()
        assert raised.value.flown.shape == (1, 4) and found.rollout().shape == (1, 10)
    finally:
        found.close()


@pytest.mark.slow
def test_a_run_on_the_wall_clock_goes_on_after_a_stop(tmp_path):
    wall = {"asynchronous": True, "operation": OperationConfig(clock="wall", speed=20.0, core=-2), "threads": 1}
    small_run(tmp_path, episodes=2, **wall).train()
    found = small_run(tmp_path, resume=True, **wall).train()
    assert len(found["episodes"]) > 2 and "resumed" in (tmp_path / "events.jsonl").read_text()


def test_what_cannot_be_sent_is_refused():
    policies = {"one": Constant(0.5)}
    crew = Crew(lambda: PlantEnv(PLANT), PLANT, policies, QUIET, OperationConfig(clock="wall"), seed=1)
    with pytest.raises(ValueError, match="cannot be sent to a process of its own"):
        ProcessOperation(crew, PlantEnv(PLANT))


def test_a_core_that_may_not_be_used_is_refused():
    with pytest.raises(ValueError, match="core=100000 is none of the cores"):
        ProcessOperation(
            Crew(simulation, PLANT, {}, QUIET, OperationConfig(clock="wall", core=100000), seed=1), PlantEnv(PLANT)
        )


def test_options_of_an_operation_need_the_operation(tmp_path):
    with pytest.raises(ValueError, match=r"operation\.\* says how an asynchronous run operates; give --asynchronous"):
        small_run(tmp_path, operation=OperationConfig(handover=5))


def test_an_interrupted_asynchronous_run_goes_on_to_the_bit(tmp_path):
    whole = small_run(tmp_path / "whole", episodes=3, asynchronous=True).train()
    small_run(tmp_path / "half", episodes=2, asynchronous=True).train()
    resumed = small_run(tmp_path / "half", episodes=3, asynchronous=True, resume=True).train()
    for one, other in zip(whole["episodes"], resumed["episodes"], strict=True):
        assert one["real_cost"] == other["real_cost"] and one["closure"] == other["closure"]
