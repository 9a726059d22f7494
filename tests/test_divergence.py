"""What diverges on the twin: a closure, a plan, an idle policy, and a live one that its update has ruined."""

import dataclasses

import pytest
import torch
from tensordict import TensorDict
from test_algorithm import flown, twinning, weights

from rt_torchrl import AssimilationConfig, DivergenceError, RefereeConfig
from rt_torchrl.steps.report import metrics


def fill(module, number):
    """Give every weight of a module this number."""
    with torch.no_grad():
        for weight in module.parameters():
            weight.fill_(number)


def unsound(found, monkeypatch, episodes, weight=1e300):
    """Let step 4 find, in these episodes, a closure under which no flight stays finite, or near what was flown."""
    update = found.assimilation.update

    def updated(*arguments):
        descended = update(*arguments)
        if found.episodes_done in episodes:
            fill(found.twin.closure, weight)
        return descended

    monkeypatch.setattr(found.assimilation, "update", updated)


@pytest.mark.parametrize("step, weight", [("plan", 1e300), ("switch", 1e300), ("plan", 20.0)])
def test_a_closure_that_cannot_be_flown_with_is_taken_back(monkeypatch, step, weight):
    """Costs are infinite, or finite and more than e⁵ times what the real episode cost."""
    found, sound = twinning(), twinning()
    for algorithm in (found, sound):
        algorithm.episode()
    earlier = weights(found.twin.closure)
    unsound(found, monkeypatch, {1}, weight)
    # Compared with an algorithm whose step 4 finds nothing new, and whose planning begins afresh.
    sound.planner.restart()
    sound.assimilation.config = dataclasses.replace(sound.assimilation.config, iterations=0)
    if step == "switch":
        for algorithm in (found, sound):
            monkeypatch.setattr(algorithm.steps["plan"], "plan", lambda *arguments: metrics())
    report, expected = found.episode(), sound.episode()
    assert report["closure_refused"] == 1.0 and expected["closure_refused"] == 0.0
    assert report["reason"].startswith("closure refused: plant") and "diverged" in report["reason"]
    assert torch.equal(weights(found.twin.closure), earlier)
    for role in found.policies:
        assert torch.equal(weights(found.policies[role]), weights(sound.policies[role]))
    assert report["J_a_model_based"] == expected["J_a_model_based"]


@pytest.mark.parametrize("live, idle", [("model_free", "model_based"), ("model_based", "model_free")])
def test_an_idle_policy_that_diverges_on_the_twin_loses_and_is_named(monkeypatch, live, idle):
    """The closure that was just found stays, the training goes on, and the live policy stays live."""
    found = twinning(referee=RefereeConfig(patience=0))
    found.referee.live, cost = live, found.twin.cost

    def checked(policy, *episodes):
        if policy is found.policies[idle]:
            raise DivergenceError("plant 'linear_quadratic' diverged")
        return cost(policy, *episodes)

    monkeypatch.setattr(found.twin, "cost", checked)
    report = found.episode()
    assert report["closure_refused"] == 0.0 and found.referee.live == live
    assert report[f"J_a_{idle}"].isinf() and report[f"J_a_{live}"].isfinite()
    assert f"{idle} diverges on the twin" in report["reason"]
    assert report["plan_accepted"] == 0.0 or idle == "model_free"


def ruined_by(half, method, policy, monkeypatch):
    """Let a method leave finite weights under which the states overflow."""
    right = getattr(half, method)

    def ruined(*arguments):
        report = right(*arguments)
        fill(policy, 1e9)
        return report

    monkeypatch.setattr(half, method, ruined)


def test_a_live_policy_that_its_update_has_ruined_puts_no_closure_in_doubt(monkeypatch):
    """The weights that flew are sound; those that step 2 made of them diverge, cost infinitely much and lose."""
    found = twinning(referee=RefereeConfig(rule="decision_tree", patience=0))
    ruined_by(found.learner, "update", found.policies["model_free"], monkeypatch)
    report = found.episode()
    assert report["closure_refused"] == 0.0 and report["J_a_model_free"].isinf()
    assert report["event"] == "swap" and found.referee.live == "model_based"
    assert "model_free diverges on the twin" in report["reason"]


def test_a_plan_that_diverges_is_refused_and_the_policy_before_stays(monkeypatch):
    found = twinning()
    before = weights(found.policies["model_based"])
    ruined_by(found.planner, "plan", found.policies["model_based"], monkeypatch)
    report = found.episode()
    assert report["plan_accepted"] == 0.0 and report["closure_refused"] == 0.0
    assert torch.equal(weights(found.policies["model_based"]), before)
    assert report["J_a_model_based"].isfinite()


@pytest.mark.parametrize("closures", [0, 1])
def test_an_interrupt_leaves_no_plan_that_nobody_has_judged(monkeypatch, closures):
    """Neither in the first plan, nor in that which repeats it with an earlier closure."""
    found, planned = twinning(), []
    before = weights(found.policies["model_based"])

    def interrupted(episodes):
        fill(found.policies["model_based"], 0.0)
        planned.append("unsound")
        raise KeyboardInterrupt if len(planned) > closures else DivergenceError("the twin diverged")

    def unsound_twin(*arguments):
        if planned and planned[-1] == "unsound":
            planned[-1] = "told"
            raise DivergenceError("the twin diverged under what has flown")

    monkeypatch.setattr(found.planner, "plan", interrupted)
    monkeypatch.setattr(found.belief, "require_sound_twin", unsound_twin)
    with pytest.raises(KeyboardInterrupt):
        found.episode()
    assert len(planned) == closures + 1 and torch.equal(weights(found.policies["model_based"]), before)


@pytest.mark.parametrize("method", ["adam", "levenberg_marquardt"])
def test_a_fit_begins_anew_where_the_present_closure_diverges_and_the_first_one_does_not(method):
    found = twinning(assimilation=AssimilationConfig(iterations=2, segment=0, method=method))
    found.episode()
    fill(found.twin.closure, 1e3)
    report = found.episode()
    assert report["J_p_before"].isinf() and report["J_p"].isfinite()
    assert all(weight.abs().max() < 10.0 for weight in found.twin.closure.parameters())
    assert all(weight.isfinite().all() for weight in found.assimilation.first.values())
    fill(found.twin.closure, 1e3)
    found.assimilation.first = {name: torch.full_like(w, 1e4) for name, w in found.assimilation.first.items()}
    report = flown(found, "assimilate", episode=TensorDict({"record": {"whole": torch.tensor(True)}, "live": "first"}))
    assert report["J_p_before"].isinf() and report["J_p"].isinf()
    assert all((weight == 1e3).all() for weight in found.twin.closure.parameters())
