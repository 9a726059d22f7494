"""Scouts: random policies on the twin, with the best of which one more plan begins."""

import copy

import pytest
import torch
from linear_quadratic import LinearGain
from test_algorithm import twinning, weights
from test_evidence import Content
from test_judgement import EPISODES, REFUTED, Other, judgement, said

from rt_torchrl.optimisers.descent import DescentConfig
from rt_torchrl.steps.plan import PlannerConfig, Planning, ShortHorizonConfig
from rt_torchrl.twinning.config import TwinningConfig
from rt_torchrl.twinning.findings import findings
from rt_torchrl.twinning.scouts import Scouts


class Seeded(type(REFUTED.virtual)):
    """Virtual episodes on which a policy costs its gain, with a source of random numbers."""

    generator = torch.Generator().manual_seed(5)


VIRTUAL = Seeded(REFUTED.virtual.twin.plant)


def drawn(generator):
    return LinearGain([[1.0 + torch.rand((), generator=generator).item(), 0.0]])


def scouts(policy, count=8, make_policy=drawn):
    return Scouts(VIRTUAL, policy, count, make_policy)


def test_scouts_are_sent_in_the_fourth_episode_and_then_ever_less_often():
    sent = scouts(LinearGain([[3.0, 0.0]]))
    assert [episode for episode in range(1, 40) if sent.due(episode)] == [4, 8, 16, 32]
    assert not scouts(LinearGain([[3.0, 0.0]]), count=0).due(4)


def test_the_cheapest_of_all_is_found_and_the_policy_keeps_its_weights(monkeypatch):
    policy = LinearGain([[3.0, 0.0]])
    sent, seen, price = scouts(policy), [], VIRTUAL.price
    with monkeypatch.context() as patched:
        patched.setattr(VIRTUAL, "price", lambda one, episodes: seen.append(said(one)) or price(one, episodes))
        found = sent.best(4, EPISODES)["gain"][0, 0].item()
    assert len(set(seen)) == 8 and found == min(seen) and said(policy) == 3.0
    assert sent.best(4, EPISODES)["gain"][0, 0] == found != sent.best(8, EPISODES)["gain"][0, 0]


def test_an_interrupt_leaves_the_policy_its_weights(monkeypatch):
    policy = LinearGain([[3.0, 0.0]])

    def interrupted(one, episodes):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(VIRTUAL, "price", interrupted)
        with pytest.raises(KeyboardInterrupt):
            scouts(policy).best(4, EPISODES)
    assert said(policy) == 3.0


def test_policies_of_another_architecture_are_refused():
    with pytest.raises(ValueError, match=r"scouts=8 draws random policies of the class LinearGain.*make_policy"):
        scouts(Other([[3.0, 0.0]]))
    assert not scouts(Other([[3.0, 0.0]]), count=0).count


@pytest.mark.parametrize(
    ("evidence", "scout", "kept"), [(None, 2.0, 2.0), (None, 2.9, 3.0), (REFUTED, 2.0, 3.0), (None, 4.0, 3.0)]
)
def test_a_plan_from_a_scout_stays_if_it_saves_a_twentieth(evidence, scout, kept):
    """The twin says 3 of the present policy; that of 2 is what flights have refuted."""
    policy = LinearGain([[3.0, 0.0]])
    planning = Planning(Content(policy), VIRTUAL, PlannerConfig())
    planning.scouts = scouts(policy, make_policy=lambda generator: LinearGain([[scout, 0.0]]))
    assert "scouted" not in planning.plan(3, EPISODES, EPISODES, judgement(evidence))
    report = planning.plan(4, EPISODES, EPISODES, judgement(evidence))
    assert said(policy) == kept and report["scouted"] == float(kept != 3.0)


def test_any_finite_cost_is_better_than_a_policy_that_diverges(monkeypatch):
    policy = LinearGain([[3.0, 0.0]])
    planning = Planning(Content(policy), VIRTUAL, PlannerConfig())
    planning.scouts = scouts(policy, make_policy=lambda generator: LinearGain([[2.0, 0.0]]))
    costs = {2.0: torch.tensor(2.0), 3.0: torch.tensor(torch.inf)}
    monkeypatch.setattr(VIRTUAL, "price", lambda policy, episodes: costs[said(policy)], raising=False)
    monkeypatch.setattr("rt_torchrl.twinning.track_record.TrackRecord.require_sound_twin", lambda *arguments: None)
    assert planning.plan(4, EPISODES, EPISODES, judgement(None))["scouted"] == 1.0 and said(policy) == 2.0


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
def test_scouts_that_find_nothing_change_no_training(optimiser):
    """Nor do they change what the next plan depends on: random numbers, and moments of Adam."""
    descent = DescentConfig(optimiser=optimiser, rate=0.01 if optimiser == "adam" else 1.0)
    planners = (PlannerConfig(iterations=5, descent=descent, scouts=count) for count in (0, 4))
    found = [twinning(arm="model_based", planner=planner) for planner in planners]
    for training in found:
        reports = [training.episode() for _ in range(6)]
    assert reports[3]["scouted"] == 0.0 and "scouted" not in reports[4]
    one, two = (weights(training.policies["model_based"]) for training in found)
    assert torch.equal(one, two) and torch.equal(*(training.generator.get_state() for training in found))


def test_what_is_not_trained_is_not_drawn():
    policy = LinearGain([[3.0, 0.0]])
    policy.gain.requires_grad_(False)
    assert scouts(policy).best(4, EPISODES)["gain"].tolist() == [[3.0, 0.0]]


def test_a_seed_may_be_any():
    virtual = copy.copy(VIRTUAL)
    virtual.generator = torch.Generator().manual_seed(-1)
    assert Scouts(virtual, LinearGain([[3.0, 0.0]]), 2, drawn).best(4, EPISODES)


def test_a_plan_from_a_scout_has_the_last_word_in_the_report():
    """What step 5 withheld before is not what is planned now."""
    policy = LinearGain([[3.0, 0.0]])
    planning = Planning(Content(policy), VIRTUAL, PlannerConfig())
    planning.scouts = scouts(policy, make_policy=lambda generator: LinearGain([[2.0, 0.0]]))
    refused = findings("no plan", plan_accepted=0.0, withheld=1.0)
    planning._from_the_present_or_earlier = lambda *arguments: refused
    report = planning.plan(4, EPISODES, EPISODES, judgement(None))
    assert report["plan_accepted"] == report["scouted"] == 1.0
    assert "withheld" not in report and "reason" not in report


def test_only_plans_over_whole_episodes_have_scouts():
    window = ShortHorizonConfig(window=5)
    assert twinning(planner=PlannerConfig(scouts=8)).planning.scouts.count == 8
    assert twinning(planner=PlannerConfig(scouts=8, short_horizon=window)).planning.scouts.count == 0
    assert TwinningConfig(planner=PlannerConfig(scouts=8, method="receding_horizon")).scouts == 0


def test_an_arm_without_plans_has_no_scouts():
    assert twinning(planner=PlannerConfig(scouts=8), arm="model_free").planning.scouts.count == 0


def test_a_wrong_number_is_refused():
    with pytest.raises(ValueError, match="scouts=-1 of the planning must not be negative"):
        PlannerConfig(scouts=-1)
