"""Why a policy is poor: each reason in a run of which it is true, and in one of which it is not."""

import dataclasses
import json
import shutil
from dataclasses import field
from typing import Literal

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic, optimal_gain

import rt_torchrl as rt
from rt_torchrl.options import configuration

pytestmark = pytest.mark.training

CLASSICAL, TWIN, MINIMUM, CLASS, INPUTS, COST, CHATTER = range(7)


class Spring(LinearGain):
    """a = −k e_1, which sees no velocity."""

    def forward(self, observation):
        return super().forward(observation[..., :1])


class Pushed(LinearQuadratic):
    """The oracle plant with a quantity of its own."""

    def merit(self, states, actions, exogenous):
        return {"mean force [N]": actions.abs().mean((-1, -2))}


PLANNER = rt.PlannerConfig(starts=0, receding_horizon=rt.PredictiveConfig(horizon=3.0))
QUIET = rt.ExplorationConfig(spread=0.0)
MODEL_BASED = rt.TwinningConfig(arm="model_based", virtual_episodes=50, exploration=QUIET, planner=PLANNER)


@configuration
class Config(rt.RunConfig):
    """A model-based training of two episodes.

    Args:
        policy: full for a gain of both states, spring for one of the position.
    """

    policy: Literal["full", "spring"] = "full"
    episodes: int = 2
    unseen: int = 4
    figures: bool = False
    twinning: rt.TwinningConfig = field(default_factory=lambda: MODEL_BASED)

    def plant(self):
        return Pushed(noise=0.01)

    def make_policy(self, plant, generator):
        return LinearGain([[0.1, 0.1]]) if self.policy == "full" else Spring([[0.1]])


class Still(rt.ClassicalController):
    """Does nothing."""

    def law(self, state, memory, exogenous):
        return torch.zeros(len(state), 1, dtype=torch.float64), memory


def finished(folder, **options):
    config = Config(log_dir=folder, **options)
    rt.Run(config, config.plant(), baselines={"still": Still}).train()
    return rt.load_run(folder, Config)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("trained") / "run").folder


@pytest.fixture
def run(trained, tmp_path):
    """A run of its own, whose results may be rewritten."""
    return rt.load_run(shutil.copytree(trained, tmp_path / "run"), Config)


def rewrite(run, *dropped, baselines=None, **changes):
    """Let the run have had episodes with other results or without some."""
    metrics = run.metrics
    metrics["summary"]["unseen"] |= {} if baselines is None else {"baselines": baselines}
    for episode in metrics["episodes"]:
        episode |= changes
        for name in dropped:
            episode.pop(name, None)
    (run.folder / "metrics.json").write_text(json.dumps(metrics))


def test_a_run_that_ended_well_has_no_reason_and_the_user_judges_that_it_acts_more(run):
    reasons = rt.diagnose(run)
    # Ten episodes from random initial states scatter too much to compare them with those of the plan.
    assert [reason.holds for reason in reasons] == [False, False, False, False, None, None, False]
    assert all(reason.evidence and reason.remedy for reason in reasons)
    evidence = reasons[COST].evidence
    assert "judge whether it is better: mean force [N]" in evidence and "against 0 of still" in evidence


def test_a_policy_above_the_least_cost_of_its_class_is_in_a_poor_minimum(run):
    gain = run.policy("model_based").gain
    with torch.no_grad():
        gain.copy_(torch.as_tensor(optimal_gain(1.0)))
        assert not rt.diagnose(run)[MINIMUM].holds
        gain.mul_(0.3)
    reason = rt.diagnose(run)[MINIMUM]
    assert reason.holds and "with the best weights" in reason.evidence


def test_a_gain_that_turns_the_action_over_in_every_interval_chatters(run):
    with torch.no_grad():
        run.policy("model_based").gain.copy_(torch.tensor([[0.0, 30.0]]))
    reason = rt.diagnose(run, episodes=2)[CHATTER]
    assert reason.holds and "force changes by more than half its range" in reason.evidence


def test_a_class_that_sees_too_little_is_too_small(tmp_path):
    reasons = rt.diagnose(finished(tmp_path, policy="spring"))
    assert reasons[CLASS].holds and not reasons[MINIMUM].holds


def test_an_alarm_is_a_twin_that_is_wrong(run):
    # Under what had flown it diverges, and no difference is known.
    rewrite(run, "paired_difference", alarm=1.0, warning="the twin diverges")
    reason = rt.diagnose(run)[TWIN]
    assert reason.holds and reason.evidence == "the twin diverges"
    rewrite(run, alarm=0.0, warning=None, paired_difference=0.7)
    reason = rt.diagnose(run)[TWIN]
    assert reason.holds is False and "cost 2.01 times what the twin says" in reason.evidence


@pytest.mark.parametrize(("count", "holds"), [(3, None), (12, True)])
def test_unseen_episodes_that_cost_more_than_planned_have_other_inputs(run, count, holds):
    """Three episodes from random initial states scatter too much to say so."""
    rewrite(run, J_a_plan=1e-3, paired_difference=0.0)
    assert rt.diagnose(run, episodes=count)[INPUTS].holds is holds


def test_what_a_run_does_not_say_is_no_reason(run):
    rewrite(run, "J_a_plan", "alarm", baselines={})
    reasons = rt.diagnose(run)
    assert [reasons[k].holds for k in (TWIN, INPUTS, COST)] == [None, None, None]


def test_predictive_control_has_no_weights_in_a_minimum(tmp_path):
    planner = dataclasses.replace(PLANNER, method="receding_horizon")
    reasons = rt.diagnose(finished(tmp_path, twinning=dataclasses.replace(MODEL_BASED, planner=planner)), episodes=2)
    assert reasons[MINIMUM].holds is None and not reasons[CLASS].holds
