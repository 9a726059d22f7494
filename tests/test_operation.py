"""Operation while learning: on a simulated clock to the bit, with limits and faults, and in a process of its own."""

import dataclasses
import math
import multiprocessing
import os
from unittest import mock

import pytest
import test_algorithm
import torch
from faulty_system import FaultySystem, Injection
from linear_quadratic import LinearQuadratic
from small_runs import SMALL, small_run
from test_faults import require_true

from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.runs import real_side
from rt_torchrl.runs.real_side import learner_threads
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.systems.config import OperatingLimitsConfig, OperationConfig, SafetyConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.exploration import ExplorationConfig
from rt_torchrl.systems.operation import operator
from rt_torchrl.systems.operation.operator import Crew, SimulatedOperation
from rt_torchrl.systems.operation.process import ProcessOperation
from rt_torchrl.systems.real_system import Reading, RealSystem
from rt_torchrl.systems.safety import SafetyLayer
from rt_torchrl.systems.sound_part import EpisodeEndedError

QUIET = ExplorationConfig(episodes=0)
NOISY = ExplorationConfig(episodes=3, spread=0.2, correlation_time=0.5)


class Stepped(PlantEnv):
    """A subclass, which is flown step by step as an operation is."""


def twinning(system, exploration=QUIET):
    """A training; ``system`` makes the real system, or the operation of one, of plant, policies and exploration."""
    plant, generator = LinearQuadratic(horizon=2.0), torch.Generator().manual_seed(0)
    policies = {role: plant.make_policy(generator) for role in ("model_free", "model_based")}
    env = system(plant, policies, exploration)
    return test_algorithm.twinning(plant, env=env, **policies, exploration=exploration, learner=test_algorithm.LEARNING)


def operation_of(learning=10, kind=PlantEnv, **options):
    """A function that makes the operation of a plant in simulation."""

    def made(plant, policies, exploration):
        crew = Crew(lambda: kind(plant), plant, policies, exploration, OperationConfig(**options), seed=7)
        return SimulatedOperation(crew.operator(), learning=learning)

    return made


def weights(found):
    parts = [*found.policies.values(), found.twin.closure]
    return torch.cat([w.detach().flatten() for part in parts for w in part.parameters()]).clone()


def trained(system, episodes=4, **options):
    found = twinning(system, **options)
    reports = [found.episode() for _ in range(episodes)]
    return found, reports


def test_learning_in_no_time_is_the_synchronous_run_to_the_bit():
    ahead, reports = trained(operation_of(learning=0, kind=Stepped))
    plain, expected = trained(lambda plant, policies, exploration: Stepped(plant))
    assert torch.equal(weights(ahead), weights(plain))
    for one, other in zip(reports, expected, strict=True):
        assert one["real_cost"] == other["real_cost"] and one["live"] == other["live"] and one["windows"] == 1.0


@pytest.mark.parametrize(("learning", "windows"), [(7, 1.0), (20, 1.0), (53, 3.0)])
def test_a_run_on_the_simulated_clock_repeats_to_the_bit(learning, windows):
    """Windows of 20 intervals: 53 intervals of learning let two more windows come in."""
    (first, reports), (again, repeated) = (trained(operation_of(learning=learning), exploration=NOISY) for _ in "ab")
    assert torch.equal(weights(first), weights(again))
    assert [report["real_cost"] for report in reports] == [report["real_cost"] for report in repeated]
    assert max(report["windows"].item() for report in reports) == windows


@pytest.mark.parametrize("continuous", [False, True])
def test_a_run_goes_on_from_its_state_to_the_bit(continuous):
    make = lambda: twinning(operation_of(continuous=continuous), exploration=NOISY)  # noqa: E731
    whole, halves = make(), make()
    for _ in range(2):
        whole.episode(), halves.episode()
    state = halves.state_dict()
    other = make()
    other.load_state_dict(state)
    found = [(whole.episode()["real_cost"], other.episode()["real_cost"]) for _ in range(2)]
    assert all(one == two for one, two in found)
    assert torch.equal(weights(whole), weights(other))


class Constant(torch.nn.Module):
    """A policy that always commands the same."""

    def __init__(self, *values):
        super().__init__()
        self.values = torch.nn.Parameter(torch.tensor(values, dtype=torch.float64))

    def forward(self, observation):
        return self.values.expand(*observation.shape[:-1], -1)


def handed_over(plant, before, after, at):
    """The commands of a window in which one constant policy takes over from another one."""
    policies = {"before": before, "after": after}
    operation = operation_of(learning=at - plant.n_steps)(plant, policies, QUIET)
    operation.hand_over("before", before, strength=0.0)
    operation.rollout()
    operation.hand_over("after", after, strength=0.0)
    return operation.rollout()[0]


def test_the_action_fades_from_one_policy_to_the_next():
    plant = LinearQuadratic(horizon=5.0)
    window = handed_over(plant, Constant(1.0), Constant(-1.0), 60)
    # A range of 4 N in 20 intervals is 0.2 N an interval.
    expected = [1.0] * 11 + [1.0 - 0.2 * k for k in range(1, 10)] + [-1.0] * 30
    torch.testing.assert_close(window["action"].flatten(), torch.tensor(expected, dtype=torch.float64))
    assert window["version"].flatten().tolist() == [0] * 10 + [1] * 40


def test_the_handover_keeps_the_actuators_own_rate(monkeypatch):
    """Torque and pitch of the turbine move by 7500 N m and 4 deg in an interval of half a second."""
    plant = WindTurbine(horizon=30.0)
    monkeypatch.setattr(operator, "HANDOVER", 1)
    window = handed_over(plant, Constant(4e4, 20.0), Constant(1e4, 0.0), 65)
    action, applied = window["action"], window["next", "applied"]
    steps = action.diff(dim=0).abs().max(0).values
    assert steps[0] <= 7500.0 + 1e-6 and steps[1] <= 4.0 + 1e-9
    # Nothing is lost in the actuators, so that what the learner reads is what the policies wanted.
    torch.testing.assert_close(applied[20:], action[20:])


@pytest.mark.parametrize("options", [{"speed": 0.0}, {"speed": math.inf}, {"clock": "sun"}])
def test_impossible_options_are_refused(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))}="):
        OperationConfig(**options)


# Operation while learning, together with limits, faults, model predictive control, and what stands around a system.


LIMITS = OperatingLimitsConfig(
    states={"velocity": (-3.0, 3.0)}, actions={"force": (-1.0, 1.0)}, rates={"force": 5.0}, tolerated=0.9
)
PLANT = LinearQuadratic(horizon=3.0)


def machine(injections=()):
    """The oracle plant behind a safety layer, with faults, as a real system."""
    system = FaultySystem(PlantEnv(PLANT, seed=0), injections, interval=PLANT.dt)
    config = SafetyConfig(interval=PLANT.dt, frozen={"state": (5, 0)}, clock="time", rates=(20.0,))
    layer = SafetyLayer(system, config, fallback=(0.0,))
    state, exogenous, applied = (Reading(keys=(name,)) for name in ("state", "exogenous", "applied"))
    return RealSystem(layer, PLANT, state=state, exogenous=exogenous, applied=applied, closure=PLANT.closure)


def operated(folder, env=None, episodes=3, limits=None, twinning=SMALL, learning=0.5, **options):
    twinning = twinning if limits is None else dataclasses.replace(twinning, limits=limits)
    shared = {"unseen": 2, "figures": False, "asynchronous": True}
    config = RunConfig(log_dir=folder, episodes=episodes, twinning=twinning, **shared | options)
    with mock.patch.object(real_side, "LEARNING", learning):
        return Run(config, PLANT, env=env)


def without_time(records):
    return [{**record, "seconds": 0} for record in records]


@pytest.mark.parametrize("continuous", [pytest.param(False, marks=pytest.mark.slow), True])
def test_limits_are_held_predicted_and_counted_and_go_on_after_a_stop(tmp_path, continuous):
    options = {"limits": LIMITS, "operation": OperationConfig(continuous=continuous), "learning": 1.4}
    run = operated(tmp_path / "whole", episodes=4, **options)
    whole = run.train()["episodes"]
    assert "predicted_violations" in whole[-1] and "predicted_violations" not in whole[0]
    assert all(record["violations/actions"] == record["violations/rates"] == 0 for record in whole)
    record = run.algorithm.short_term[-1]
    assert record.actions.abs().max() <= 1.0 and record.actions.diff(dim=0).abs().max() <= 0.5 + 1e-12
    if not continuous:  # a layer has no state that could be put back: the operation then begins with a reset
        operated(tmp_path / "cut", episodes=2, **options).train()
        resumed = operated(tmp_path / "cut", episodes=4, resume=True, **options).train()["episodes"]
        assert without_time(resumed) == without_time(whole)


@pytest.mark.parametrize("continuous", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("injection", "kind", "kept"),
    [
        pytest.param(Injection("nan", 8), "not finite", 28, marks=pytest.mark.slow),
        (Injection("frozen", 8, 12), "frozen", 24),  # known at reading 11, and wrong from the first repetition on
        pytest.param(Injection("repeated", 8), "clock", 28, marks=pytest.mark.slow),
        (Injection("raises", 15), "ended", 15),
        (Injection("ends_early", 15), "ended", 15),
    ],
    ids=lambda value: getattr(value, "kind", None),
)
def test_a_fault_costs_its_own_intervals_alone(tmp_path, injection, kind, kept, continuous):
    operation = OperationConfig(continuous=continuous)
    run = operated(tmp_path, machine([injection]), learning=0.0, operation=operation)
    algorithm = run.algorithm
    found, stored = [], []
    for _ in range(3):
        found.append(algorithm.episode())
        stored.append(len(algorithm.learner.memory))
        require_true(PLANT, algorithm.short_term[-1])
        if len(found) == 2:
            assert kind in {fault.kind for fault in algorithm.flights.faults}
            assert found[1][f"faults/{kind}"] == 1 and found[1]["sound_intervals"] == kept
    assert [b - a for a, b in zip([0, *stored], stored, strict=False)] == [30, kept, 30]
    run._held.release()


def test_a_reading_refused_at_the_end_of_a_window_is_not_the_start_of_the_next(tmp_path):
    """Where nothing is reset, the last reading of a window is the first one of the next."""
    operation = OperationConfig(continuous=True)
    run = operated(tmp_path, machine([Injection("nan", 29)]), learning=0.0, operation=operation)
    stored = []
    for _ in range(3):
        run.algorithm.episode()
        require_true(PLANT, run.algorithm.short_term[-1])
        stored.append(len(run.algorithm.learner.memory))
    assert stored == [30, 59, 88]
    run._held.release()


class Unreachable(PlantEnv):
    """A system that fails in its third reset."""

    resets = 0

    def _reset(self, *args, **options):
        self.resets += 1
        if self.resets == 3:
            raise ConnectionError("no answer")
        return super()._reset(*args, **options)


def test_a_reset_that_fails_is_tried_again(tmp_path):
    found = twinning(operation_of(learning=0, kind=Unreachable))
    reports = [found.episode() for _ in range(4)]
    assert (
        reports[2]["episodes_refused"] == 1
        and "failed in its reset: ConnectionError: no answer" in reports[2]["refusal"]
    )
    assert [fault.kind for fault in found.flights.faults] == [] and reports[3]["windows"] == 1


@pytest.mark.slow
def test_model_predictive_control_acts_while_the_twin_learns_and_goes_on_after_a_stop(tmp_path):
    from test_predictive_training import FIT, PLANNER

    twinning = dataclasses.replace(SMALL, planner=PLANNER, assimilation=FIT, arm="model_based")
    whole = operated(tmp_path / "whole", twinning=twinning).train()["episodes"]
    operated(tmp_path / "cut", twinning=twinning, episodes=2).train()
    resumed = operated(tmp_path / "cut", twinning=twinning, resume=True).train()["episodes"]
    times = ("seconds", "solve_median", "solve_max")
    for one, other in zip(whole, resumed, strict=True):
        assert one["late_solves"] == 0.0 < one["solve_median"]
        assert {k: v for k, v in one.items() if k not in times} == {k: v for k, v in other.items() if k not in times}


# An operation in a process of its own, with true clocks, and whole runs of it.


SHORT = LinearQuadratic(horizon=1.0)


class Breaking(PlantEnv):
    """A system that raises in the fifth interval of its second window."""

    def _step(self, tensordict):
        if self._episodes == 2 and self._step_count.item() == 4:
            raise OSError("the sensor's cable is cut")
        return super()._step(tensordict)


def breaking():
    return Breaking(SHORT)


def simulation():
    return PlantEnv(SHORT)


def operation(make_env=simulation, **options):
    policies = {"one": Constant(0.5), "two": Constant(-0.5)}
    config = OperationConfig(clock="wall", speed=10.0, **options)
    return ProcessOperation(Crew(make_env, SHORT, policies, QUIET, config, seed=1), make_env()), policies


@pytest.mark.parametrize(
    "options, expected",
    [
        ({}, 0),
        ({"asynchronous": True}, 0),
        ({"asynchronous": True, "operation": OperationConfig(clock="wall")}, 2),
        ({"asynchronous": True, "operation": OperationConfig(clock="wall"), "threads": 7}, 7),
    ],
)
def test_the_learner_leaves_a_core_to_what_acts(options, expected, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
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
def test_an_acting_process_that_was_killed_is_said():
    found, policies = operation()
    try:
        found.hand_over("one", policies["one"], strength=0.0)
        found.rollout()
        (process,) = multiprocessing.active_children()
        process.kill()
        process.join()
        with pytest.raises(RuntimeError, match="the acting process has ended without a word"):
            while True:  # windows that came before
                found.rollout()
        with pytest.raises(RuntimeError, match="the acting process has ended without a word"):
            found.hand_over("two", policies["two"], strength=0.0)
    finally:
        found.close()


@pytest.mark.slow
def test_a_run_on_the_wall_clock_goes_on_after_a_stop(tmp_path):
    wall = {"asynchronous": True, "operation": OperationConfig(clock="wall", speed=20.0), "threads": 1}
    small_run(tmp_path, episodes=2, **wall).train()
    found = small_run(tmp_path, resume=True, **wall).train()
    assert len(found["episodes"]) > 2


def test_what_cannot_be_sent_is_refused():
    policies = {"one": Constant(0.5)}
    crew = Crew(lambda: PlantEnv(SHORT), SHORT, policies, QUIET, OperationConfig(clock="wall"), seed=1)
    with pytest.raises(ValueError, match="cannot be sent to a process of its own"):
        ProcessOperation(crew, PlantEnv(SHORT))
