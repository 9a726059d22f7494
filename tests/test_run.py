"""A whole run on the oracle plant: results, resuming, interrupting, and what is refused before any work."""

import dataclasses
import json
from functools import partial

import pytest
import torch
from linear_quadratic import LinearQuadratic
from small_runs import FULL, SMALL, believing, small_run, stepped_cost
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensordict.nn import TensorDictModule
from test_hypotheses import LAG, Suspecting
from torchrl.collectors import Collector

import rt_torchrl as rt
from rt_torchrl.steps.config import AssimilationConfig, HypothesesConfig, PlannerConfig, RefereeConfig
from rt_torchrl.steps.learn import ActorCritic
from rt_torchrl.steps.memory import LongTermMemory
from rt_torchrl.steps.plan import MultiStart, make_planner
from rt_torchrl.steps.switch import DecisionTree, clones

pytestmark = pytest.mark.training


def test_a_run_leaves_its_results_readable(tmp_path):
    run = small_run(tmp_path, episodes=4, figures=True, unseen_every=2)
    metrics = run.train()
    kept = {f"checkpoint-000{k}.pt" for k in (2, 3, 4)}
    assert {path.name for path in tmp_path.glob("checkpoint*")} == kept
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert [record["episode"] for record in metrics["episodes"]] == [1, 2, 3, 4]
    promised, summary = {"J_p", "J_a_model_based", "J_a_model_free"}, metrics["summary"]
    assert all(promised | {"live", "real_cost", "event", "seconds"} <= record.keys() for record in metrics["episodes"])
    ratios = {"J_p_ratio", "J_a_ratio_model_based", "J_a_ratio_model_free"}
    assert ratios | {"unseen", "closure", "seconds"} <= set(summary) and promised <= set(summary["unseen"])
    assert json.loads((tmp_path / "config.json").read_text())["episodes"] == 4
    assert {"states.png", "learning_curves.png"} <= {path.name for path in (tmp_path / "figures").iterdir()}
    logged = [event.value for event in EventAccumulator(str(tmp_path)).Reload().Scalars("twin/J_p")]
    # TensorBoard keeps single precision.
    assert logged == pytest.approx([record["J_p"] for record in metrics["episodes"]], rel=1e-6)
    each = summary["unseen"]["J_p_each"]
    assert len(each) == 3 and sum(each) / 3 == pytest.approx(summary["unseen"]["J_p"]["mean"], rel=1e-12)
    # Ratios are costs after over costs before on the real plant.
    before, after = (
        stepped_cost(run.unseen, policies["model_based"]) for policies in (run.initial_policies, run.algorithm.policies)
    )
    # Sums in another order: rounding only.
    assert summary["J_a_ratio_model_based"] == pytest.approx(after / before, rel=1e-12)
    # The live policy is judged on them during the training where that is asked for.
    assert ["J_a_unseen" in record for record in metrics["episodes"]] == [False, True, False, True]
    mean = summary["unseen"][f"J_a_{summary['live']}"]["mean"]
    # Two libraries sum the costs, in an order that depends on the machine.
    assert metrics["episodes"][3]["J_a_unseen"] == pytest.approx(mean, rel=1e-14)


def test_a_twin_may_believe_in_another_plant(tmp_path):
    class Heavier(LinearQuadratic):
        B = ((0.0,), (0.75,))

    run = small_run(tmp_path, 1, Heavier(horizon=2.0), config=believing(LinearQuadratic(horizon=2.0)))
    found = run.train()["summary"]
    assert isinstance(run.algorithm.env.plant, Heavier) and not isinstance(run.algorithm.twin.plant, Heavier)
    assert isinstance(run.unseen.plant, Heavier)
    # The twin is judged with the physics it believes in.
    twin, flown = run.algorithm.twin, run.unseen.fly(run.algorithm.policies[found["live"]])
    replayed = rt.Rollout(twin.plant, twin.closure)(run.unseen.initial_state, run.unseen.exogenous, flown.actions)
    expected = rt.identification_cost(twin.plant, replayed, flown.states).mean().item()
    assert found["unseen"]["J_p"]["mean"] == pytest.approx(expected, rel=1e-9)


def assert_same(whole, parts):
    """Two results are the same, except for the time that they took."""
    for one, other in zip(whole["episodes"], parts["episodes"], strict=True):
        assert {**one, "seconds": None} == {**other, "seconds": None}
    for metrics in (whole, parts):
        del metrics["summary"]["seconds"]
    assert whole["summary"] == parts["summary"]


PARTS = dataclasses.replace(
    SMALL,
    exploration=rt.ExplorationConfig(spread=0.005),
    hypotheses=HypothesesConfig(),
    assimilation=AssimilationConfig(iterations=3, method="levenberg_marquardt", inputs="record"),
    planner=PlannerConfig(iterations=2),
    learner=dataclasses.replace(FULL.learner, algorithm="td3"),
    referee=RefereeConfig(clone_patience=0),
    limits=rt.OperatingLimitsConfig(states={"velocity": (-50.0, 50.0)}, rates={"force": 39.0}),
)
"""All parts of the method that the paper does not have."""
DEARER = 1.25
"""What the real system costs more than its twin says: beyond chance, so that plans are corrected."""


class Dear(Suspecting):
    def running_cost(self, t, state, applied, exogenous):
        return DEARER * super().running_cost(t, state, applied, exogenous)


def with_all_parts(folder, episodes, **options):
    """A run on a system with a lag that its twin suspects, and with costs that contradict the twin."""
    system, config = rt.LaggedActuator(Dear(horizon=2.0), "force", LAG), believing(Suspecting(horizon=2.0))
    return small_run(folder, episodes, system, config=config, twinning=PARTS, **options)


def test_an_interrupt_and_a_resumption_leave_no_trace_in_all_parts(tmp_path, monkeypatch):
    whole = with_all_parts(tmp_path / "whole", 3)
    started = [weight.clone() for weight in whole.algorithm.policies["model_free"].parameters()]
    found, plan = whole.train(), MultiStart.forward

    def pressed(self, flowing):
        if flowing["number"] == 1:
            raise KeyboardInterrupt
        return plan(self, flowing)

    monkeypatch.setattr(MultiStart, "forward", pressed)
    interrupted = with_all_parts(tmp_path / "parts", 3)
    assert len(interrupted.train()["episodes"]) == 1
    monkeypatch.undo()
    resumed = with_all_parts(tmp_path / "parts", 3, resume=True)
    # It was judged and saved as its last whole episode left it.
    its, ours = interrupted.algorithm, resumed.algorithm
    assert len(its.learner.memory) == len(ours.learner.memory) == 20
    assert clones(its.twin.closure, ours.twin.closure)
    assimilation, twin = resumed.algorithm.assimilation, resumed.algorithm.twin
    assert assimilation.called and twin.weights == {"lags": 1.0} and assimilation.turns["late"].pause > 1
    assert resumed.algorithm.belief.flown
    assert ["predicted_violations" in record for record in found["episodes"]] == [False, True, True]
    assert_same(found, resumed.train())
    learned = whole.algorithm.policies["model_free"].parameters()
    assert not any(torch.equal(*pair) for pair in zip(started, learned, strict=True))
    assert torch.equal(whole.algorithm.generator.get_state(), resumed.algorithm.generator.get_state())


def test_a_step_that_is_too_coarse_for_its_plant_is_a_warning_before_any_work(tmp_path):
    with pytest.warns(UserWarning, match=r"step of dt=1.5 s of plant 'linear_quadratic' errs by 7\.\d\d% of its move"):
        rt.Run(rt.RunConfig(log_dir=tmp_path), LinearQuadratic(dt=1.5, horizon=30.0))


def test_a_plant_that_breaks_its_contract_is_refused(tmp_path):
    class Forgetful(LinearQuadratic):
        def observe(self, t, state, exogenous):
            return state.detach()

    for plant, config in ((Forgetful(), rt.RunConfig), (LinearQuadratic(), believing(Forgetful()))):
        with pytest.raises(rt.PlantContractError, match="observe: its derivative by state 'position' is 0, by finite"):
            small_run(tmp_path / "run", 1, plant, config=config)
    assert not (tmp_path / "run").exists()


def test_parts_of_ones_own_take_the_places_of_the_default_ones(tmp_path):
    """Each is made once, and a run of parts like the default ones is the default run, by TorchRL's collector, too."""
    made = []

    def noted(name, make):
        def maker(*arguments, **named):
            made.append(name)
            return make(*arguments, **named)

        return maker

    def plain_collector(env, actor, plant):
        acting = TensorDictModule(actor, in_keys=["observation", "state", "exogenous"], out_keys=["action"])
        return Collector(env, acting, frames_per_batch=plant.n_steps, total_frames=-1, reset_at_each_iter=True)

    def run(folder, **parts):
        return small_run(tmp_path / folder, parts=parts, twinning=FULL).train()

    parts = {
        "learner": partial(ActorCritic, replay=noted("replay", LongTermMemory)),
        "planner": make_planner,
        "referee": DecisionTree,
        "collector": plain_collector,
    }
    usual = run("usual")
    own = run("own", **{name: noted(name, make) for name, make in parts.items()})
    assert sorted(made) == ["collector", "learner", "planner", "referee", "replay"]
    for ours, its in zip(own["episodes"], usual["episodes"], strict=True):
        for name in ("real_cost", "J_p", "J_a_model_based", "J_a_model_free", "td_error"):
            assert ours[name] == pytest.approx(its[name], rel=1e-9), name
