"""The safety layer around systems in simulation, around Gymnasium and as part of a real system."""

import json
import math
from collections import Counter
from pathlib import Path

import pytest
import torch
from faulty_system import as_reported
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import Time
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded
from torchrl.envs import GymEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from rt_torchrl import PlantEnv, SafetyConfig
from rt_torchrl.systems.safety import ActionLimits, SafetyLayer, Watchdog, report_of

DT = 0.1


class Failing(PlantEnv):
    """A system whose observation fails, and comes late, at the steps that the test names; steps count from 0."""

    def __init__(self, plant, clock, *, broken=(), late=(), value=float("nan")):
        super().__init__(plant, seed=0)
        self.clock, self.broken, self.late, self.value = clock, set(broken), set(late), value

    def _step(self, tensordict):
        k = int(self._step_count)
        found = super()._step(tensordict)
        self.clock.now += 0.5 if k in self.late else 0.01
        if k in self.broken:
            found["observation"] = found["observation"].index_fill(-1, torch.tensor([0]), self.value)
        return found


def layer(env=None, *, fallback=(0.0,), clock=None, horizon=2.0, **options):
    env = PlantEnv(LinearQuadratic(horizon=horizon), seed=0) if env is None else env
    made = SafetyLayer(env, SafetyConfig(interval=DT, **options), fallback=fallback)
    made.clock = clock or Time()
    return made


def failing(clock=None, horizon=2.0, broken=(), late=(), value=float("nan"), **options):
    clock = clock or Time()
    env = Failing(LinearQuadratic(horizon=horizon), clock, broken=broken, late=late, value=value)
    return layer(env, clock=clock, **options)


def fly(env, asked, steps=None):
    """Fly an episode in which the policy asks for these actions."""
    asked = iter(asked)
    policy = TensorDictModule(
        lambda e: torch.full((*e.shape[:-1], 1), float(next(asked)), dtype=torch.float64), ["observation"], ["action"]
    )
    return env.rollout(steps or 20, policy)


def counts(env):
    """The number of intervals in which each reason occurred."""
    return Counter(reason for event in report_of(env).events for reason in event.reasons)


def applied(episode):
    return episode["next", "applied"].flatten().tolist()


def test_range_then_rate_are_exact():
    """a_k = clip(clip(asked, −1, 1.5), a_{k−1} ± r Δt) by a loop over plain numbers."""
    asked = [0.1, 3.0, 3.0, 0.9, -2.0, -2.0, -2.0, -2.0, -2.0, -2.0, 0.5, 0.55, 0.5, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, -2.0]
    episode = fly(layer(low=(-1.0,), high=(1.5,), rates=(4.0,)), asked)
    last, expected = 0.0, []
    for value in asked:
        last = min(max(min(max(value, -1.0), 1.5), last - 0.4), last + 0.4)
        expected.append(last)
    # Rounding of sums of up to four increments.
    assert applied(episode) == pytest.approx(expected, abs=1e-14)
    assert episode["action"].flatten().tolist() == asked
    assert max(applied(episode)) == 1.5 and min(applied(episode)) == -1.0


@pytest.mark.parametrize("last", [9.0, -9.0, 1.9])
def test_what_the_rate_allows_still_lies_in_the_range(last):
    spec = Bounded(low=-2.0, high=2.0, shape=(1,), dtype=torch.float64)
    limits = ActionLimits(spec, SafetyConfig(interval=0.05, rates=(10.0,)))
    sent, held = limits(torch.tensor([0.0], dtype=torch.float64), torch.tensor([last], dtype=torch.float64))
    # Half a unit towards zero, or the end of the range where that is still outside.
    assert sent.item() == pytest.approx(math.copysign(min(2.0, abs(last) - 0.5), last), abs=1e-14)
    assert set(held) == ({"rate"} if abs(last) < 2.0 else {"range", "rate"})


def test_nothing_is_touched_within_the_limits():
    asked = (1.5 * torch.sin(torch.arange(20.0))).tolist()
    env = layer(rates=(40.0,), ranges={"observation": (-1e3, 1e3)}, deadline=1.0)
    episode, bare = fly(env, asked), fly(PlantEnv(LinearQuadratic(horizon=2.0), seed=0), asked)
    for key in ("observation", "state", "reward", "applied", "truncated", "terminated", "done"):
        assert torch.equal(episode["next", key], bare["next", key])
    assert not env.report.events


def test_a_broken_observation_trips_for_the_hold_time_and_is_held():
    env = failing(broken=[4, 5], fallback=(-1.0,), hold=0.3)
    episode = fly(env, [0.5] * 20)
    # The observations after steps 4 and 5 are broken, at 0.5 and 0.6 s: the fallback acts from 0.5 s to 0.9 s.
    assert applied(episode) == [0.5] * 5 + [-1.0] * 4 + [0.5] * 11
    assert episode["next", "tripped"].flatten().tolist() == [4 <= k <= 7 for k in range(20)]
    observation = episode["next", "observation"]
    assert observation.isfinite().all()
    assert (observation[0, 4:6, 0] == observation[0, 3, 0]).all()
    # The other component was a number and is passed on.
    assert torch.equal(observation[..., 1], episode["next", "state"][..., 1])
    assert counts(env) == {"not finite": 2, "fallback": 4}
    first = env.report.events[0]
    assert (first.step, first.reasons, first.asked, first.applied) == (4, {"not finite": "observation"}, [0.5], [0.5])
    assert first.time == pytest.approx(0.4)
    assert [event.step for event in env.report.events] == [4, 5, 6, 7, 8]


FREE = {"low": (-math.inf,), "high": (math.inf,), "rates": (math.inf,), "deadline": math.inf}
SPIKE = {"value": 7.0, "ranges": {"observation": ((-5.0, -50.0), (5.0, 50.0))}}


@pytest.mark.parametrize(
    ("options", "asked", "expected", "reasons"),
    [
        ({"broken": [4]}, [0.5] * 20, [0.5] * 5 + [-1.0] + [0.5] * 14, {"not finite": 1, "fallback": 1}),
        ({"broken": [3], **SPIKE}, [0.5] * 20, [0.5] * 4 + [-1.0] + [0.5] * 15, {"out of range": 1, "fallback": 1}),
        ({"late": [6], "deadline": 0.2}, [0.5] * 20, [0.5] * 7 + [-1.0] + [0.5] * 12, {"late": 1, "fallback": 1}),
        ({}, [0.5] * 3 + [math.nan] + [0.5] * 16, [0.5] * 3 + [-1.0] + [0.5] * 16, {"asked": 1, "fallback": 1}),
        (FREE, [1.5, -1.5] * 10, [1.5, -1.5] * 10, {}),
    ],
)
def test_one_fault_brings_the_fallback_for_one_interval(options, asked, expected, reasons):
    """A late reading is no wrong one; a value out of range is passed on; infinity limits nothing."""
    env = failing(fallback=(-1.0,), **options)
    episode = fly(env, asked)
    assert applied(episode) == expected and counts(env) == reasons
    assert episode["next", "refused"].sum() == len(options.get("broken", ()))
    if "value" in options:
        assert episode["next", "observation"][0, 3, 0] == 7.0


@pytest.mark.parametrize("t", [0.0, 9e6, 3e9])
def test_a_fault_trips_however_long_a_system_has_run(t):
    for hold, expected in ((0.0, [True, False, False]), (7200.0, [True, True, False])):
        watchdog = Watchdog(SafetyConfig(interval=3600.0, hold=hold))
        watchdog.note(t, faulty=True)
        assert [watchdog.tripped(t + 3600.0 * k) for k in range(3)] == expected


def test_the_fallback_begins_where_a_system_begins_beyond_its_limits():
    env = layer(fallback=(-1.0,), limits={"state": (1e3, 1e4)})
    assert env.reset()["tripped"].item() and applied(fly(env, [0.5] * 20)) == [-1.0] * 20


def test_a_controller_as_fallback_sees_the_last_finite_observation():
    env = failing(broken=[4], fallback=lambda found: 0.25 * found["observation"][..., :1])
    episode = fly(env, [0.5] * 20)
    assert applied(episode)[5] == 0.25 * episode["next", "observation"][0, 3, 0].item()


def test_events_are_written_as_json_lines_and_a_new_episode_begins_anew(tmp_path):
    path = tmp_path / "deep" / "events.jsonl"
    env = failing(broken=[19], fallback=(-1.0,), hold=1.0, log=path)
    for _ in range(2):
        # The watchdog is tripped at the end of the episode; the next one does not inherit that.
        assert applied(fly(env, [float("nan")] + [3.0] * 19))[:12] == [-1.0] * 10 + [2.0] * 2
        assert counts(env) == {"asked": 1, "fallback": 10, "range": 10, "not finite": 1}
    found = [json.loads(line) for line in path.read_text().splitlines()]
    assert [(entry["episode"], entry["step"]) for entry in found] == [(n, k) for n in (1, 2) for k in range(20)]
    assert found[0]["asked"] == [None] and found[0]["applied"] == [-1.0] and "asked" in found[0]["reasons"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this machine has no /dev/full")
def test_a_log_on_a_full_disk_does_not_stop_a_machine_that_moves():
    env = layer(rates=(0.1,), log=Path("/dev/full"))
    with pytest.warns(UserWarning, match="events are missing in /dev/full: .*No space left"):
        assert fly(env, [1.0] + [-1.0] * 19).shape[1] == 20 and counts(env)["rate"] == 19


def test_specs_hold_around_both_kinds_of_systems():
    check_env_specs(layer())
    pytest.importorskip("gymnasium")
    check_env_specs(layer(GymEnv("Pendulum-v1"), rates=(10.0,)))


def test_the_report_of_a_layer_within_a_transformed_environment_is_that_layers_own():
    """A transformed environment passes names on to what it transforms, whose own ``env`` is the system in the layer."""
    guarded = failing(broken=[1])
    inner = TransformedEnv(guarded, StepCounter())
    for env in (inner, as_reported(inner, LinearQuadratic(horizon=2.0))):
        fly(env, [0.0] * 3, steps=3)
        assert report_of(env) is guarded.report and guarded.report.wrong == {1} and counts(env)["not finite"] == 1


def test_a_fallback_that_gives_no_number_is_told():
    with pytest.raises(ValueError, match="fallback gave"):
        fly(failing(broken=[1], fallback=lambda found: torch.full((1, 1), torch.nan)), [0.0] * 20)
