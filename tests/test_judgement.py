"""Whatever gives a policy new weights is judged alike: plans from other weights, updates of step 2, clones."""

import copy
import math

import pytest
import torch
from linear_quadratic import LinearGain
from tensordict import TensorDict
from test_evidence import Content, judge_of
from test_first_controller import twinning

from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.twinning.cloning import Cloning
from rt_torchrl.twinning.distillation import DistillationConfig
from rt_torchrl.twinning.judgement import Costs, Judgement
from rt_torchrl.twinning.learning import Learning
from rt_torchrl.twinning.planners import PlannerConfig
from rt_torchrl.twinning.planning import Planning
from rt_torchrl.twinning.track_record import TrackRecord

EPISODES = Scenario(torch.zeros(1, 2).double(), torch.zeros(1, 20, 1).double())
REFUTED = judge_of([2.0, 3.0], [2.0, 0.0])
"""The twin says 2 of weights that cost 2e², and 3 of weights that cost 3."""


def judgement(evidence):
    return Judgement(lambda cost, than: cost > than, TrackRecord({}), evidence)


def gains(first):
    return {"gain": torch.tensor([[first, 0.0]], dtype=torch.float64)}


def said(policy):
    return policy.gain[0, 0].item()


class Hasty(Content):
    """A learner whose update gives its policy the refuted weights."""

    def update(self):
        self.policy.load_state_dict(gains(2.0))
        return TensorDict({})

    store = observations = Content.refuse


def exactly(teacher, pupil, **others):
    pupil.load_state_dict(teacher.state_dict())
    return 0.0


class Other(LinearGain):
    """The same law in another architecture."""


def test_without_evidence_costs_are_those_of_the_twin():
    policy = LinearGain([[2.0, 0.0]])
    assert judgement(None).costs(policy, REFUTED.virtual, EPISODES) == Costs(2.0, 2.0, 2.0)
    found = judgement(REFUTED).costs(policy, REFUTED.virtual, EPISODES)
    assert found.twin == 2.0 and found.median == pytest.approx(2.0 * math.exp(2.0), rel=0.05)


@pytest.mark.parametrize("approach", [0, 1])
@pytest.mark.parametrize(("evidence", "kept"), [(None, 2.0), (REFUTED, 3.0)])
def test_a_plan_from_other_weights_that_flights_refute_is_refused(approach, evidence, kept, monkeypatch):
    policy = LinearGain([[3.0, 0.0]])
    planning = Planning(Content(policy), REFUTED.virtual, PlannerConfig(approach=approach, approach_at=1))
    monkeypatch.setattr("rt_torchrl.twinning.planning.by_small_steps", lambda *arguments: None)
    (planning._first if approach else planning.others).append(gains(2.0))
    report = planning.plan(1, EPISODES, EPISODES, judgement(evidence))
    assert said(policy) == kept
    assert not approach or report["approached"] == float(evidence is None)


@pytest.mark.parametrize(("evidence", "kept"), [(None, 2.0), (REFUTED, 3.0)])
def test_an_update_that_flights_refute_is_taken_back(evidence, kept):
    learner = Hasty(LinearGain([[3.0, 0.0]]))
    learning = Learning(learner, REFUTED.virtual)
    learning.update()
    report = learning.judge(EPISODES, judgement(evidence))
    assert said(learner.policy) == kept and report["update_accepted"] == float(evidence is None)


@pytest.mark.parametrize(("evidence", "kept"), [(None, 2.0), (REFUTED, 3.0)])
def test_an_update_that_was_taken_back_is_judged_again_where_the_step_is_repeated(evidence, kept):
    """With another closure, of which the flights may say something else."""
    learner = Hasty(LinearGain([[3.0, 0.0]]))
    learning = Learning(learner, REFUTED.virtual)
    learning.update()
    assert learning.judge(EPISODES, judgement(REFUTED))["update_accepted"] == 0.0
    report = learning.judge(EPISODES, judgement(evidence))
    assert said(learner.policy) == kept and report["update_accepted"] == float(evidence is None)


@pytest.mark.parametrize("sound", [False, True])
def test_an_unsound_twin_leaves_the_update_to_another_closure(sound, monkeypatch):
    """Nothing flies on the twin. If what has flown does not, either, the step is repeated, with the update."""
    virtual, learner = copy.copy(REFUTED.virtual), Hasty(LinearGain([[3.0, 0.0]]))
    monkeypatch.setattr(virtual, "cost", lambda policy, episodes: torch.tensor(math.inf), raising=False)
    given = Judgement(lambda cost, than: not cost < than, TrackRecord({}))
    monkeypatch.setattr(given.track_record, "policy_flown", lambda: LinearGain([[1.0, 0.0]]))
    learning = Learning(learner, virtual)
    learning.update()
    if sound:
        monkeypatch.setattr(virtual, "cost", lambda policy, _: torch.tensor(math.inf if said(policy) > 1.0 else 1.0))
        assert not learning.judge(EPISODES, given)["update_accepted"] and said(learner.policy) == 3.0
    else:
        with pytest.raises(DivergenceError):
            learning.judge(EPISODES, given)
        assert said(learner.policy) == 2.0


@pytest.mark.parametrize(("evidence", "kept"), [(None, 2.0), (REFUTED, 3.0)])
def test_a_clone_replaces_weights_that_flights_refute(evidence, kept):
    live, idle = LinearGain([[3.0, 0.0]]), Other([[2.0, 0.0]])
    cloning = Cloning(REFUTED.virtual, DistillationConfig(), 1)
    cloning.distillation.imitate = exactly
    report = cloning.clone(
        live,
        idle,
        seen=lambda: torch.zeros(1, 2).double(),
        record=REFUTED.record,
        costs=(3.0, 2.0),
        judged_on=EPISODES,
        judgement=judgement(evidence),
    )
    assert said(idle) == kept and ("reason" in report) == (evidence is None)


GAINS = {"ruined": -0.6, "better": 0.9}


def updated(wanted, **options):
    """An algorithm after an episode in which step 2 sets the gains of the model-free policy; the imitation has 0.4."""
    found = twinning(**options)
    critic = found.learner.update

    def update():
        report = critic()
        found.policies["model_free"].gain.data.fill_(GAINS[wanted])
        return report

    found.learner.update = update
    return found, found.episode()


def test_a_worse_update_is_taken_back_and_its_moments_are_forgotten():
    found, report = updated("ruined", judged_updates=True)
    gain = found.policies["model_free"].gain.detach()
    torch.testing.assert_close(gain, torch.tensor([[0.4, 0.3]], dtype=torch.float64), rtol=1e-2, atol=1e-2)
    assert report["update_accepted"] == 0.0 and "update refused: J_a of model_free would be" in report["reason"]
    assert not found.learner.actor_adam.steps[0] and report["weight_change"] < 1e-2


def test_a_better_update_stays():
    found, report = updated("better", judged_updates=True)
    assert report["update_accepted"] == 1.0 and "reason" not in report
    assert found.policies["model_free"].gain.detach().unique().tolist() == [GAINS["better"]]


@pytest.mark.parametrize("options", [{}, {"judged_updates": True, "arm": "model_free"}])
def test_every_update_stays_where_none_is_judged(options):
    found, report = updated("ruined", **options)
    assert "update_accepted" not in report
    assert found.policies["model_free"].gain.detach().unique().tolist() == [GAINS["ruined"]]
