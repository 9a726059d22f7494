"""Model predictive control in the place of the model-based policy, in the whole method and in the recipes."""

import dataclasses

import pytest
import torch
from linear_quadratic import LinearQuadratic
from small_runs import FULL, SMALL, small_run
from test_export_recipe import recipe

from rt_torchrl import AssimilationConfig, PlannerConfig, PredictiveConfig, PredictiveControl, RunConfig, load_run
from rt_torchrl.steps.switch import clones

pytestmark = pytest.mark.training

PLANNER = PlannerConfig(method="receding_horizon", receding_horizon=PredictiveConfig(horizon=1.0))
FIT = AssimilationConfig(iterations=10, inputs="record", method="lbfgs")


class Config(RunConfig):
    """The oracle plant with model predictive control."""

    def plant(self):
        return LinearQuadratic(horizon=2.0, noise=0.5)


def training(folder, episodes, *, twinning=None, **options):
    chosen = dataclasses.replace(SMALL, **({"planner": PLANNER, "assimilation": FIT} | (twinning or {})))
    return small_run(folder, episodes, Config().plant(), config=Config, unseen=2, twinning=chosen, **options)


@pytest.mark.parametrize("rule", ["decision_tree", "expected_cost"])
def test_it_acts_the_twin_is_fitted_and_the_other_half_learns(tmp_path, rule):
    referee = dataclasses.replace(SMALL.referee, rule=rule)
    run = training(tmp_path, 4, twinning={"learner": FULL.learner, "referee": referee})
    records = run.train()["episodes"]
    acted = [record for record in records if record["live"] == "model_based"]
    assert acted and all(record["diverged_solves"] == 0.0 < record["solve_median"] for record in acted)
    for record in records:
        assert record["J_a_plan"] == record["J_a_plan_before"] and record["plan_accepted"] == 1.0
        assert ("solve_median" in record) == (record["live"] == "model_based") and "critic_loss" in record
    assert len(run.algorithm.learner.memory) == 4 * 20
    true = run.algorithm.twin.plant.closure.matrix
    assert torch.dist(run.algorithm.twin.closure.matrix, true) < 0.5 * torch.dist(run.initial_closure.matrix, true)


def test_in_the_arm_of_the_model_it_acts_from_the_first_episode_and_plans_on_the_twins_closure(tmp_path):
    run = training(tmp_path, 2, twinning={"arm": "model_based"}, noise=0.02)
    twin, controller = run.algorithm.twin, run.algorithm.policies["model_based"]
    before = twin.closure.matrix.detach().clone()
    assert [record["live"] for record in run.train()["episodes"]] == ["model_based"] * 2
    assert controller.closure is twin.closure and not torch.equal(before, controller.closure.matrix)
    assert controller.forecast.time.isfinite().all()
    assert torch.equal(run.initial_policies["model_based"].closure.matrix, before)


def test_the_live_controller_is_distilled_and_never_a_clone_itself(tmp_path):
    run = training(tmp_path, 1)
    algorithm = run.algorithm
    algorithm.referee.live = "model_based"
    algorithm.episode()
    algorithm.referee.live = "model_based"
    judged = algorithm.virtual.draw(2)
    policies, clone = algorithm.policies, algorithm.module["switch"].imitation.clone
    given = {"seen": algorithm.learner.observations, "record": algorithm.short_term[-1], "judged_on": judged}
    found = clone(policies["model_based"], policies["model_free"], **given)
    assert 0.0 < found["distillation_error"] < 0.3
    refused = clone(policies["model_free"], policies["model_based"], **given)
    assert refused["event"] == "keep" and "PredictiveControl plans its actions" in refused["reason"]
    run._held.release()


def test_a_run_is_read_back_and_says_what_can_be_exported(tmp_path, monkeypatch):
    run = training(tmp_path, 2)
    run.train()
    loaded = load_run(tmp_path, Config)
    controller = loaded.policy("model_based")
    assert isinstance(controller, PredictiveControl) and controller.closure is loaded.closure
    assert clones(controller, run.algorithm.policies["model_based"])
    export = recipe("export")
    monkeypatch.setattr(export.rt, "load_run", lambda folder, _: load_run(folder, Config))
    for what in ("policy", "controller"):
        with pytest.raises(ValueError, match="cannot be exported; export the model-free policy.*--role model_free"):
            export.main(export.Config(run=tmp_path, what=(what,), formats=("c",)))
    export.main(export.Config(run=tmp_path, role="model_free"))
    assert (tmp_path / "exported" / "linear_quadratic_model_free.c").is_file()
