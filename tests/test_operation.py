"""Operation while learning: windows and orders in the process of the test, and in a process of their own."""

import contextlib
import itertools
import math
import multiprocessing

import pytest
import test_algorithm
import torch
from faulty_system import FaultySystem, Injection, as_reported
from linear_quadratic import Constant, LinearQuadratic
from small_runs import small_run
from test_classical import PD
from test_faults import require_true

import rt_torchrl as rt
from rt_torchrl.steps.switch import Imitation
from rt_torchrl.systems import operation as module
from rt_torchrl.systems.config import OperatingLimitsConfig, OperationConfig, SafetyConfig
from rt_torchrl.systems.operation import FIRST, Operation, Operator

QUIET = rt.ExplorationConfig(episodes=0)
NO_TIME = 1e9
"""Speed of a system that takes no time."""


class Stepped(rt.PlantEnv):
    """A subclass, which is flown step by step as an operation is."""


class InProcess(Operation):
    """An operation in the process of the test, in which learning takes no time."""

    def __init__(self, plant, policies, exploration, env, **options):
        config = OperationConfig(speed=NO_TIME, **options)
        super().__init__(Operator(None, plant, policies, exploration, config, seed=7), env)
        self.operator = Operator(lambda: env, plant, policies, exploration, config, seed=7)
        self.operator.start()

    def _pass_on(self, order):
        self.operator.follow(order, order.ready(self.operator.policies))

    def waiting(self):
        return False

    def rollout(self):
        window = self.operator.window(self.receive)
        return self._take(window._replace(entries=module.together(window.entries)), self.version)

    def receive(self):
        """Nothing is ordered within a window."""

    def close(self):
        pass


def twinning(system, plant, **options):
    """A training; ``system`` makes the real system, or the operation of one, of plant, policies and exploration."""
    generator = torch.Generator().manual_seed(0)
    policies = {role: plant.make_policy(generator) for role in ("model_free", "model_based")}
    env = system(plant, policies, QUIET)
    return test_algorithm.twinning(plant, env=env, **policies, exploration=QUIET, **options)


def weights(found):
    parts = [*found.policies.values(), found.twin.closure]
    return torch.cat([w.detach().flatten() for part in parts for w in part.parameters()]).clone()


def test_learning_in_no_time_is_the_synchronous_run_to_the_bit():
    plant, options = LinearQuadratic(horizon=2.0), {"learner": test_algorithm.LEARNING}
    ahead = twinning(lambda *parts: InProcess(*parts, Stepped(plant)), plant, **options)
    plain = twinning(lambda *parts: Stepped(plant), plant, **options)
    for _ in range(4):
        one, other = ahead.episode(), plain.episode()
        assert one["real_cost"] == other["real_cost"] and one["live"] == other["live"] and one["windows"] == 1.0
    assert torch.equal(weights(ahead), weights(plain))


def handed_over(plant, before, after, at, env=None):
    """The commands of a window in which one constant policy takes over from another one."""
    policies = {"before": before, "after": after}
    found = InProcess(plant, policies, QUIET, env or rt.PlantEnv(plant))
    found.hand_over("before", before, strength=0.0)
    intervals = itertools.count()
    found.receive = lambda: found.hand_over("after", after, strength=0.0) if next(intervals) == at else None
    return found.rollout()[0]


def test_the_action_fades_from_one_policy_to_the_next():
    plant = LinearQuadratic(horizon=5.0)
    window = handed_over(plant, Constant(1.0), Constant(-1.0), 10)
    # A range of 4 N in 20 intervals is 0.2 N an interval.
    expected = [1.0] * 11 + [1.0 - 0.2 * k for k in range(1, 10)] + [-1.0] * 30
    torch.testing.assert_close(window["action"].flatten(), torch.tensor(expected, dtype=torch.float64))
    assert window["version"].flatten().tolist() == [0] * 10 + [1] * 40


# Operation while learning, together with limits and faults.


LIMITS = OperatingLimitsConfig(states={"velocity": (-9.0, 9.0)}, actions={"force": (-1.0, 1.0)}, rates={"force": 20.0})
PLANT = LinearQuadratic(horizon=3.0)


def machine(injections=(), fallback=(0.0,), **options):
    """The oracle plant behind a safety layer, with faults, as a real system; the plant itself goes on for long."""
    system = FaultySystem(rt.PlantEnv(LinearQuadratic(horizon=300.0), seed=0), injections)
    config = SafetyConfig(interval=PLANT.dt, frozen={"state": (5, 0)}, **options)
    return as_reported(rt.SafetyLayer(system, config, fallback=fallback), PLANT, closure=PLANT.closure)


def operated(env, *, continuous=False, **options):
    make = lambda *parts: InProcess(*parts, env, continuous=continuous)  # noqa: E731
    return twinning(make, PLANT, **options)


def test_a_policy_that_asks_for_no_number_leaves_nothing_to_the_next():
    window = handed_over(PLANT, Constant(math.nan), Constant(0.5), 10, env=machine())
    assert window["next", "applied"].flatten().tolist() == [0.0] * 10 + [0.5] * 20


@pytest.mark.parametrize("continuous", [False, True])
def test_limits_are_held_predicted_and_counted(continuous):
    found = operated(machine(**rt.OperatingLimits(PLANT, LIMITS).safety()), limits=LIMITS, continuous=continuous)
    reports = [found.episode() for _ in range(3)]
    assert reports[-1]["predicted_violations"] == 0.0 and "predicted_violations" not in reports[0].keys()  # noqa: SIM118
    assert all(report["violations/actions"] == report["violations/rates"] == 0 for report in reports)
    assert found.short_term[-1].actions.abs().max() <= 1.0


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize(
    ("injection", "kind", "kept"),
    [
        (Injection("nan", 8), "not finite", 28),
        (Injection("frozen", 8, 12), "frozen", 24),  # known at reading 11, and wrong from the first repetition on
        (Injection("raises", 15), "ended", 15),
        (Injection("ends_early", 15), "ended", 15),
    ],
    ids=lambda value: getattr(value, "kind", None),
)
def test_a_fault_costs_its_own_intervals_alone(injection, kind, kept, continuous):
    found = operated(machine([injection]), continuous=continuous)
    reports, stored = [], []
    for _ in range(3):
        reports.append(found.episode())
        stored.append(len(found.learner.memory))
        require_true(PLANT, found.short_term[-1])
        snapshot = rt.Snapshot.take(found, found.twin.closure, [])
        assert len(snapshot.large_scale) == len(snapshot.record.actions)
    assert reports[1][f"faults/{kind}"] == 1 and reports[1]["sound_intervals"] == kept
    assert [b - a for a, b in zip([0, *stored], stored, strict=False)] == [30, kept, 30]


def test_a_reading_refused_at_the_end_of_a_window_is_not_the_start_of_the_next():
    """Where nothing is reset, the last reading of a window is the first one of the next."""
    found, stored = operated(machine([Injection("nan", 29)]), continuous=True), []
    for _ in range(3):
        found.episode()
        require_true(PLANT, found.short_term[-1])
        stored.append(len(found.learner.memory))
    assert stored == [30, 59, 88]


# An operation in a process of its own, with true clocks, and whole runs of it.


SHORT = LinearQuadratic(horizon=1.0)


def endless():
    return as_reported(rt.PlantEnv(LinearQuadratic(horizon=300.0)), SHORT)


@contextlib.contextmanager
def operation(make_env, **options):
    """An operation that flies its first window by the first of two constant policies, which ends with the block."""
    policies = {"one": Constant(0.5), "two": Constant(-0.5)}
    config = OperationConfig(speed=10.0, **options)
    found = Operation(Operator(make_env, SHORT, policies, QUIET, config, seed=1), make_env())
    try:
        found.hand_over("one", policies["one"], strength=0.0)
        assert found.rollout()["version"].eq(0).all()
        yield found, policies["two"]
    finally:
        found.close()


@pytest.mark.slow
def test_a_policy_takes_over_in_the_other_process_without_a_bump():
    with operation(endless, continuous=True) as (found, other):
        found.hand_over("two", other, strength=0.0)
        window = found.rollout()
        while window["version"].max() < 1:
            window = found.rollout()
        window = torch.cat([window, found.rollout()], 1)[0]
    action = window["action"].flatten()
    # A range of 4 N in 20 intervals is 0.2 N an interval.
    assert action[0] == 0.5 and action[-1] == -0.5 and action.diff().abs().max() <= 0.2 + 1e-12
    assert torch.equal(window["state"][10], window["next", "state"][9])  # continuous
    assert (window["late"] >= 0.0).all() and (window["late"] > 0.0).any()


@pytest.mark.slow
def test_an_acting_process_that_was_killed_is_said():
    with operation(endless) as (found, _):
        (process,) = multiprocessing.active_children()
        process.kill()
        process.join()
        with pytest.raises(RuntimeError, match="the acting process has ended without a word"):
            while True:  # windows that came before
                found.rollout()


@pytest.mark.slow
def test_a_run_goes_on_after_a_stop(tmp_path):
    wall = {"asynchronous": True, "operation": OperationConfig(speed=20.0), "threads": 1}
    small_run(tmp_path, episodes=2, **wall).train()
    found = small_run(tmp_path, resume=True, **wall).train()
    assert len(found["episodes"]) > 2


class Seasonal(LinearQuadratic):
    """The oracle plant in a swing that pulls with a period of two seconds."""

    def vector_field(self, t, state, action, exogenous, closure):
        pull = torch.sin(math.pi * t).unsqueeze(-1) + torch.zeros_like(action)
        return super().vector_field(t, state, action, exogenous + pull, closure)


class Shifting(LinearQuadratic):
    """Its cost counts from the third second on."""

    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous) * (t > 3.0)


class Clocked(LinearQuadratic):
    def observe(self, t, state, exogenous):
        return torch.stack([state[..., 0], torch.cos(math.pi * t) + 0.0 * state[..., 0]], -1)


def test_windows_that_go_on_need_a_plant_that_is_the_same_in_each():
    whole, part = {"horizon": 4.0}, {"horizon": 5.0}  # two periods, and two and a half
    timed = [(Seasonal, part, "step"), (Shifting, part, "running_cost"), (Clocked, part, "observe")]
    for kind, horizon, method in timed:
        plant = kind(**horizon)
        with pytest.raises(ValueError, match=f"at t = 0 again, but {method} of plant .* tell the time"):
            InProcess(plant, {}, QUIET, as_reported(rt.PlantEnv(plant), plant), continuous=True)
    for plant in (Seasonal(**whole), Clocked(**whole), rt.StackedObservations(LinearQuadratic(**part), 2)):
        assert not module.answers_by_time(plant)
    assert module.answers_by_time(rt.StackedObservations(Clocked(**part), 2)) == ["step", "observe"]


def test_the_first_controller_goes_on_while_policies_are_expected_to_cost_twice_as_much(monkeypatch):
    monkeypatch.setattr(Imitation, "imitate", lambda *given, **data: 1.0)
    plant = LinearQuadratic(horizon=2.0)
    controller, planner = PD(plant, (0.4, 0.3)), rt.PlannerConfig(iterations=0, starts=0)

    def system(plant, policies, exploration):
        return InProcess(plant, {FIRST: controller, **policies}, exploration, Stepped(plant))

    found = twinning(system, plant, first=rt.FirstController(controller), planner=planner)
    with torch.no_grad():
        for policy in found.policies.values():
            policy.gain.fill_(-1.0)
    reports = [found.episode() for _ in range(2)]
    assert [report["live"] for report in reports] == [FIRST, FIRST] and not found.belief.flown
    assert [float(report["version"]) for report in reports] == [1.0, 2.0] and len(found.belief.first) == 3
