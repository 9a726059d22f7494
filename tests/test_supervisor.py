"""Operating limits: held on the real side, predicted on the twin before a policy acts, and counted."""

import dataclasses
import math

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from small_runs import SMALL, small_run
from test_algorithm import flown as after
from test_algorithm import twinning

import rt_torchrl as rt
from rt_torchrl.runs.run_start import simulated
from rt_torchrl.steps.switch import other_than

LIMITS = rt.OperatingLimitsConfig(
    states={"velocity": (-3.0, 3.0)}, actions={"force": (-1.0, 1.0)}, rates={"force": 5.0}
)


def limited(limits=LIMITS, **options):
    plant = LinearQuadratic(horizon=2.0)
    options = {"referee": rt.RefereeConfig(rule="decision_tree")} | options  # which keeps every update
    config = rt.SafetyConfig(interval=plant.dt, **rt.OperatingLimits(plant, limits).safety())
    layer = rt.SafetyLayer(rt.PlantEnv(plant, seed=0), config, fallback=(0.0,))
    return twinning(plant, env=layer, limits=limits, **options)


def test_what_leaves_a_limit_is_found_by_hand():
    plant = LinearQuadratic(horizon=0.4)
    states = torch.tensor([[0.0, 9.0], [0.0, 3.0], [9.0, -3.1], [0.0, 0.0], [0.0, math.nan]]).double()
    actions = torch.tensor([[1.0], [0.5], [-0.1], [1.1]]).double()
    found = rt.OperatingLimits(plant, LIMITS).broken(rt.Trajectory(states, actions, torch.zeros(4, 1).double()))
    # The first state is nobody's fault, NaN lies between no limits, and steps of 0.5 are 5 N/s.
    assert found["states"].tolist() == [False, True, False, True]
    assert found["actions"].tolist() == [False, False, False, True]
    assert found["rates"].tolist() == [False, False, True, True]


def test_the_layer_holds_them_for_every_policy_and_the_record_counts():
    found = limited()
    found.policies["model_free"].gain.data.fill_(40.0)
    report = found.episode()
    applied = found.short_term[-1].actions
    assert applied.abs().max() == 1.0 and applied.diff(dim=0).abs().max() <= 0.5 + 1e-12
    assert report["violations/actions"] == report["violations/rates"] == 0
    velocities = found.short_term[-1].states[1:, 1]
    assert report["violations/states"] == (velocities.abs() > 3.0).sum()
    assert sum("limit" in event.reasons for event in found.env.report.events) == report["violations/states"]


def test_a_policy_that_would_leave_them_does_not_act():
    found = limited()
    for policy in found.policies.values():
        policy.gain.data.fill_(0.05)
    found.episode()
    found.planner.policy.gain.data.fill_(0.05)
    wild = LinearGain([[80.0, -80.0]]).state_dict()
    found.policies[found.referee.live].load_state_dict(wild)
    live = found.referee.live
    idle = other_than(live)
    _, role, report = found.steps["interact"].supervisor.choose(live)
    assert role == idle and f"{live} may not act" in report["reason"] and report["predicted_violations"] == 0.0
    # The oracle: the same share by a flight of the twin.
    episodes = found.virtual.draw(5)
    share = found.steps["interact"].supervisor.predicted(found.policies[live], episodes)
    flown = found.twin.control(found.policies[live], *episodes)
    beyond = (flown.states[:, 1:, 1].abs() > 3.0) | (flown.actions[..., 0].abs() > 1.0)
    jumps = torch.cat([torch.zeros(5, 1), flown.actions[..., 0].diff(dim=1)], 1).abs() > 0.5 * (1 + 1e-9)
    assert share == pytest.approx((beyond | jumps).double().mean().item()) and share > 0.2
    # Neither: the weights that were cleared last act, under their role.
    found.policies[idle].load_state_dict(wild)
    last, role, report = found.steps["interact"].supervisor.choose(live)
    assert role == idle and last is not found.policies[idle] and "reason" in report
    assert torch.equal(last.gain, torch.full_like(last.gain, 0.05))
    assert after(found)["live"] == idle
    assert torch.equal(found.belief.policy_of(found.belief.flown[-1]).gain, last.gain)


def test_without_a_policy_that_may_act_the_training_says_so():
    found = limited(dataclasses.replace(LIMITS, states={"position": (-1e-3, 1e-3)}))
    found.episode()
    with pytest.raises(ValueError, match="no policy may act. .*would leave the limits in .* --start controller"):
        found.episode()
    with pytest.raises(ValueError, match="no safety layer that holds them"):
        twinning(limits=LIMITS)


@pytest.mark.parametrize("limits", [{}, {"actions": {"force": (-0.3, 0.3)}}, {"rates": {"force": 2.0}}])
def test_a_perfect_twin_flies_again_what_the_layer_sent(limits, tmp_path):
    fixed = dataclasses.replace(SMALL.assimilation, iterations=0)
    exploration = rt.ExplorationConfig(spread=0.5, episodes=9)
    options = {"limits": rt.OperatingLimitsConfig(**limits), "assimilation": fixed, "exploration": exploration}
    run = small_run(tmp_path, episodes=2, twinning=dataclasses.replace(SMALL, **options))
    run.algorithm.twin.closure.load_state_dict(LinearQuadratic().closure.state_dict())
    for record in run.train()["episodes"]:
        # Rounding of sums over twenty intervals.
        assert record["paired_difference"] == pytest.approx(0.0, abs=1e-9) and record["alarm"] == 0.0
    actions = run.algorithm.short_term[-1].actions
    assert (actions.abs().max() > 0.3 + 1e-9) == ("actions" not in limits)


class Lagged(rt.ClassicalController):
    """a = −2 m, where m follows the velocity."""

    memory_size = 1

    def law(self, state, memory, exogenous):
        memory = 0.8 * memory + 0.2 * state[..., 1:]
        return -2.0 * memory, memory


def test_the_memory_of_the_fallback_goes_on_while_the_policy_acts():
    """At the second trip the former controller knows what it would know had it watched all the time."""
    limits = rt.OperatingLimitsConfig(states={"velocity": (-0.7, 0.7)})
    config = rt.RunConfig(twinning=dataclasses.replace(SMALL, limits=limits), seed=3)
    plant = LinearQuadratic(horizon=4.0)
    env = simulated(plant, config, Lagged, device=torch.device("cpu"))
    row, memory, fallback, acted = env.reset(), 0.0, [], {}
    for k in range(40):
        memory = 0.8 * memory + 0.2 * row["state"][0, 1].item()
        tripped, asked = row["tripped"].item(), 1.0 if k < 20 else -1.0
        if tripped:
            acted[k] = -2.0 * memory
        row = env.step(row.set("action", torch.tensor([[asked]]).double()))
        if tripped:
            fallback.append((k, row["next", "applied"].item()))
        row = env.step_mdp(row)
    steps = [k for k, _ in fallback]
    assert len(steps) > 4 and any(later > first + 1 for first, later in zip(steps, steps[1:], strict=False))
    assert dict(fallback) == pytest.approx(acted, rel=1e-12)
