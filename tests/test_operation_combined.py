"""Operation while learning, together with limits, faults, model predictive control, and what stands around a system."""

import dataclasses

import pytest
import torch
from linear_quadratic import LinearQuadratic
from small_runs import SMALL

from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.faulty_system import FaultySystem, Injection
from rt_torchrl.systems.operating_limits_config import OperatingLimitsConfig
from rt_torchrl.systems.operation.config import OperationConfig
from rt_torchrl.systems.reading import Reading
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.systems.safety import SafetyConfig, SafetyLayer
from rt_torchrl.systems.sound_part import EpisodeEndedError

LIMITS = OperatingLimitsConfig(
    states={"velocity": (-3.0, 3.0)}, actions={"force": (-1.0, 1.0)}, rates={"force": 5.0}, tolerated=0.9
)
PLANT = LinearQuadratic(horizon=3.0)


def faulty(kind, first, last=None, episode=1, **options):
    return Injection(kind=kind, first=first, last=last, episode=episode, **options)


def machine(injections=()):
    """The oracle plant behind a safety layer, with faults, as a real system."""
    system = FaultySystem(PlantEnv(PLANT, seed=0), injections, interval=PLANT.dt)
    config = SafetyConfig(interval=PLANT.dt, frozen={"state": (5, 0)}, clock="time", rates=(20.0,))
    layer = SafetyLayer(system, config, fallback=(0.0,))
    state, exogenous, applied = (Reading(keys=(name,)) for name in ("state", "exogenous", "applied"))
    return RealSystem(layer, PLANT, state=state, exogenous=exogenous, applied=applied, closure=PLANT.closure)


def trained(folder, env=None, episodes=3, limits=None, twinning=SMALL, **options):
    twinning = twinning if limits is None else dataclasses.replace(twinning, limits=limits)
    shared = {"compiled": False, "unseen": 2, "untrained": 0, "figures": False, "asynchronous": True}
    config = RunConfig(log_dir=folder, episodes=episodes, twinning=twinning, **shared | options)
    return Run(config, PLANT, env=env)


def without_time(records):
    return [{**record, "seconds": 0} for record in records]


@pytest.mark.parametrize("continuous", [pytest.param(False, marks=pytest.mark.slow), True])
def test_limits_are_held_predicted_and_counted_and_go_on_after_a_stop(tmp_path, continuous):
    options = {"limits": LIMITS, "operation": OperationConfig(continuous=continuous, learning=1.4)}
    run = trained(tmp_path / "whole", episodes=4, **options)
    whole = run.train()["episodes"]
    assert "predicted_violations" in whole[-1] and "predicted_violations" not in whole[0]
    assert all(record["violations/actions"] == record["violations/rates"] == 0 for record in whole)
    record = run.algorithm.short_term[-1]
    assert record.actions.abs().max() <= 1.0 and record.actions.diff(dim=0).abs().max() <= 0.5 + 1e-12
    if not continuous:  # a layer has no state that could be put back: the operation then begins with a reset
        trained(tmp_path / "cut", episodes=2, **options).train()
        resumed = trained(tmp_path / "cut", episodes=4, resume=True, **options).train()["episodes"]
        assert without_time(resumed) == without_time(whole)


def require_true(record):
    """The record is what the plant did under what its actuators did."""
    t = record.start + PLANT.dt * torch.arange(len(record.actions), dtype=torch.float64)
    ends = PLANT.step(t, record.states[:-1], record.actions, record.exogenous, PLANT.closure).state
    torch.testing.assert_close(ends, record.states[1:], rtol=0, atol=1e-12)


@pytest.mark.parametrize("continuous", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("injection", "kind", "kept"),
    [
        pytest.param(faulty("nan", 8), "not finite", 28, marks=pytest.mark.slow),
        (faulty("frozen", 8, 12), "frozen", 24),  # known at reading 11, and wrong from the first repetition on
        pytest.param(faulty("repeated", 8), "clock", 28, marks=pytest.mark.slow),
        (faulty("raises", 15), "ended", 15),
        (faulty("ends_early", 15), "ended", 15),
    ],
    ids=lambda value: getattr(value, "kind", None),
)
def test_a_fault_costs_its_own_intervals_alone(tmp_path, injection, kind, kept, continuous):
    operation = OperationConfig(continuous=continuous, learning=0.0)
    run = trained(tmp_path, machine([injection]), operation=operation)
    algorithm = run.algorithm
    found, stored = [], []
    for _ in range(3):
        found.append(algorithm.episode())
        stored.append(len(algorithm.learner.memory))
        require_true(algorithm.short_term[-1])
        if len(found) == 2:
            assert kind in {fault.kind for fault in algorithm.flights.faults}
            assert found[1][f"faults/{kind}"] == 1 and found[1]["sound_intervals"] == kept
    assert [b - a for a, b in zip([0, *stored], stored, strict=False)] == [30, kept, 30]
    run._held.release()


def test_a_reading_refused_at_the_end_of_a_window_is_not_the_start_of_the_next(tmp_path):
    """Where nothing is reset, the last reading of a window is the first one of the next."""
    run = trained(tmp_path, machine([faulty("nan", 29)]), operation=OperationConfig(continuous=True, learning=0.0))
    stored = []
    for _ in range(3):
        run.algorithm.episode()
        require_true(run.algorithm.short_term[-1])
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
    from test_operation import operation_of, twinning

    found = twinning(operation_of(learning=0, kind=Unreachable))
    reports = [found.episode() for _ in range(4)]
    assert reports[2]["episodes_refused"] == 1 and "ConnectionError: no answer" in reports[2]["refusal"]
    assert [fault.kind for fault in found.flights.faults] == [] and reports[3]["windows"] == 1
    with pytest.raises(EpisodeEndedError, match="failed in its reset: ConnectionError"):
        other = twinning(operation_of(learning=0, kind=Unreachable))
        other.operation = other.env
        other.env.hand_over("model_free", other.policies["model_free"], strength=0.0)
        for _ in range(3):
            other.env.rollout()


@pytest.mark.slow
def test_model_predictive_control_acts_while_the_twin_learns_and_goes_on_after_a_stop(tmp_path):
    from test_predictive_training import FIT, PLANNER

    twinning = dataclasses.replace(SMALL, planner=PLANNER, assimilation=FIT, arm="model_based")
    whole = trained(tmp_path / "whole", twinning=twinning).train()["episodes"]
    trained(tmp_path / "cut", twinning=twinning, episodes=2).train()
    resumed = trained(tmp_path / "cut", twinning=twinning, resume=True).train()["episodes"]
    times = ("seconds", "solve_median", "solve_max")
    for one, other in zip(whole, resumed, strict=True):
        assert one["late_solves"] == 0.0 < one["solve_median"]
        assert {k: v for k, v in one.items() if k not in times} == {k: v for k, v in other.items() if k not in times}


def test_model_predictive_control_that_asks_a_critic_is_refused(tmp_path):
    from test_predictive_training import PLANNER

    planner = dataclasses.replace(
        PLANNER, receding_horizon=dataclasses.replace(PLANNER.receding_horizon, terminal="critic")
    )
    with pytest.raises(ValueError, match=r"receding_horizon.terminal='critic' does not go with asynchronous"):
        trained(tmp_path, twinning=dataclasses.replace(SMALL, planner=planner))
