"""Results of a run: numbers, tables, its bar, loggers, callbacks and files of options."""

import dataclasses
import json
import math
import re
import time
from unittest.mock import Mock

import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from small_runs import SMALL, small_run, stepped_cost
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_algorithm import STEPS, twinning
from test_export_recipe import RECIPES

from rt_torchrl import PlannerConfig, ReinforcementTwinning, TwinningConfig
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.runs import dashboard, results, table
from rt_torchrl.runs.command_line import from_command_line
from rt_torchrl.runs.dashboard import Progress
from rt_torchrl.runs.loaded_run import config_class_of
from rt_torchrl.runs.settings import settings_of
from rt_torchrl.runs.table import next_steps
from rt_torchrl.runs.table import progress as progress_line


def test_metrics_are_json_where_nothing_was_iterated(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(LinearQuadratic, "closure_inputs", ("position [m]", "velocity [m/s]"))
    monkeypatch.setattr(LinearQuadratic, "closure_outputs", ("drift [m/s]", "force [m/s²]"))
    nothing = {part: dataclasses.replace(getattr(SMALL, part), iterations=0) for part in ("assimilation", "planner")}
    twinning = dataclasses.replace(SMALL, **nothing)
    metrics = small_run(tmp_path, 1, twinning=twinning).train()
    assert json.loads((tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail) == metrics
    assert metrics["episodes"][0]["J_p"] is None and metrics["episodes"][0]["real_cost"] > 0.0
    table = capsys.readouterr().out
    assert "J_a model-based" in table
    assert re.search(r"where its last records went, position \[m\] from .*\n    (drift|force) \[.*\] from", table)


def judged(seed):
    """Two unseen episodes of a worn system, whose mean costs depend on the draw."""
    unseen = UnseenEpisodes(LinearQuadratic(horizon=1.0, noise=0.5), 2, seed=seed)
    unseen.closure = LinearClosure(torch.zeros(2, 2))
    return unseen


def test_the_better_policy_is_chosen_on_other_episodes_than_it_is_reported_on():
    policies = {"model_based": LinearGain([[0.0, 0.5]]), "model_free": LinearGain([[0.8, 0.5]])}
    algorithm = Mock(spec=ReinforcementTwinning, policies=policies)
    differs = 0
    for seed in range(4):
        unseen = judged(seed)
        other = unseen.validation()
        assert not torch.equal(other.initial_state, unseen.initial_state) and len(other.initial_state) == 2
        assert other.closure is unseen.closure
        # Chosen alike for every seed of the unseen episodes, which play no part in it.
        assert results.better_of(algorithm, unseen) == cheapest(policies, judged(2_000_000))
        differs += cheapest(policies, unseen) != cheapest(policies, other)
    assert differs > 0


def cheapest(policies, episodes):
    return min(policies, key=lambda role: stepped_cost(episodes, policies[role]))


# The bar of a training says what is under way.


def test_it_names_each_step_as_it_begins():
    told = []
    twinning().episode(told.append)
    assert told == STEPS and set(dashboard.WORDS) == {"start", "fit", "imitation", *STEPS}


def test_a_log_has_a_line_for_each_episode_and_for_what_changes_or_begins_after_a_while(monkeypatch, capsys):
    with Progress(3) as bar:
        bar.doing("checking the gradient")
        bar.doing("assimilate")
        for episode in (1, 2):
            bar.episode({"episode": episode, "real_cost": 0.25, "live": "model_free", "alarm": 2.0 - episode})
        bar.episode({"episode": 3, "real_cost": 0.25, "live": "first", "reason": "model_based may not act: it is dear"})
        monkeypatch.setattr(dashboard, "QUIET", 0.0)
        bar.doing("plan")
    shown = capsys.readouterr()
    costs = [f"episode {k}/3: real 0.25, live {'first' if k == 3 else 'model-free'}" for k in (1, 2, 3)]
    assert shown.err.splitlines() == ["checking the gradient", *costs, "planning"]
    told = shown.out.split("episode ")[1:]
    assert [text.split()[-1] for text in told] == ["wrong", "again", "dear"]


# Callbacks, early stopping, files of options, and the summary at the end of a run.


TURBINE = config_class_of(RECIPES / "wind_turbine.py")


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run of at most four episodes that a callback ends after two."""
    folder, two = tmp_path_factory.mktemp("habits") / "run", [lambda found: "two are enough" if found[1:] else None]
    metrics = small_run(folder, 4, parts={"callbacks": two}).train()
    assert len(metrics["episodes"]) == 2
    return folder, metrics


def test_tensorboard_has_the_final_costs_and_the_table(stopped):
    tags = EventAccumulator(str(stopped[0])).Reload().Tags()
    assert "final/unseen.J_a_model_free.mean" in tags["scalars"] and "results/text_summary" in tags["tensors"]


def test_options_of_a_file_and_of_a_run_that_goes_on_hold_beside_those_that_are_given(tmp_path):
    """The seed and a preset need not be said again, and what is said beside replaces what the run had."""
    asked = from_command_line(TURBINE, ["--preset", "paper", "--seed", "3", "--log-dir", str(tmp_path)])
    file, few = tmp_path / "config.json", tmp_path / "mine.json"
    file.write_text(json.dumps(settings_of(asked, "wind_turbine") | {"ran": []}, default=str))
    resumed = from_command_line(TURBINE, ["--resume", "--log-dir", str(tmp_path), "--episodes", "30"])
    assert resumed == dataclasses.replace(asked, resume=True, episodes=30)
    again = from_command_line(TURBINE, ["--config", str(file), "--seed", "4"])
    assert again == dataclasses.replace(asked, seed=4, log_dir=None)
    few.write_text(json.dumps({"episodes": 7, "twinning": {"planner": {"iterations": 3}}}))
    found, default = from_command_line(TURBINE, ["--config", str(few)]), from_command_line(TURBINE, [])
    assert (found.episodes, found.twinning.planner.iterations) == (7, 3)
    assert found.twinning.planner.realisations == default.twinning.planner.realisations == 50


def test_the_next_step_follows_from_the_results(stopped, tmp_path):
    metrics = stopped[1]
    live = metrics["summary"]["live"]
    cost = metrics["summary"]["unseen"][f"J_a_{live}"]["mean"]

    def said(better, controller, planner="multi_start", place="simulation", greatest=0.9, alarm=0.0, **summary):
        beside = {
            "J_a": {"mean": controller},
            "merit": {},
            "ratio": {"confidence_interval": [0.9 * cost / controller, greatest]},
        }
        unseen = metrics["summary"]["unseen"] | {"judged_on": place, "baselines": {"PI": beside}}
        found = metrics["summary"] | {"unseen": unseen, "better": better} | summary
        config = TURBINE(twinning=TwinningConfig(planner=PlannerConfig(method=planner)))
        return next_steps({"summary": found, "episodes": [{"alarm": alarm}]}, tmp_path, config)

    first = {"expected": 3.0, "paid": 2.0}
    told = said(live, 0.5 * cost, greatest=2.1)
    assert "the live policy is dearer than PI: keep it" in told and "take --policy mlp" not in told  # it is one
    for greatest in (1.01, 0.9995):  # a gain of rounding is none
        assert "the live policy is not clearly better than PI: keep it" in said(live, 1.1 * cost, greatest=greatest)
    for high in (0.8, 1.2):  # flights on a real system whose episodes are never the same
        flown = {
            live: {"J_a": {"mean": 1.0, "confidence_interval": [0.7, high]}},
            "PI": {"J_a": {"mean": 1.2, "confidence_interval": [1.1, 1.3]}},
        }
        told = said(live, 2.0 * cost, place="twin", real_unseen={"controllers": flown})
        assert ("not clearly better than PI" in told) == (high > 1.1)
    for place in ("simulation without noise of the sensors", "simulation"):
        assert ("--real-unseen 5" in said(live, 2.0 * cost, place=place)) == (place != "simulation")
    other = "model_free" if live == "model_based" else "model_based"
    assert f"({other.replace('_', '-')}): export that role" in said(other, 2.0 * cost)
    told = said(live, 2.0 * cost, place="twin", first=first, alarm=1.0)
    assert "not clearly better than the controller that flew first: keep it" in told
    assert "recipes/export.py" in said(live, 2.0 * cost, place="twin", first=first)  # one episode beside twenty
    assert "recipes/export.py" in said(live, 2.0 * cost, place="twin", first={"expected": 2.0, "paid": 3.0})
    assert "recipes/export.py" in said(live, 2.0 * cost, first=first)  # other episodes tell more
    assert said("model_free", math.inf, live="model_free").endswith("--role model_free")
    planned = said("model_based", math.inf, "receding_horizon", live="model_based")
    assert planned.endswith("--what twin")


def test_errors_of_the_twin_are_told_in_units_over_what_was_fitted():
    rms, line = {"rotor_speed [rad/s]": 0.0123456, "shares [-]": None}, "RMS rotor_speed 0.0123 rad/s, shares diverges"
    for segment, where in ((0, "its last records"), (22, "segments of 22 intervals")):
        found = {"rms": rms, "segment": segment, "noise": {}, "standard_errors": {}}
        assert table.fit_lines(found) == [f"  twin over {where}: {line}"]
    record = {"J_p": 1.0, "real_cost": 0.5, "live": "model_free"} | {f"rms/{name}": rms[name] for name in rms}
    assert progress_line(record) == f"{line}, real 0.5, live model-free"


def test_every_window_is_paid_and_episodes_are_counted_from_one():
    windows = {"real_cost": 2.0, "windows": 3.0, "largest_cost": 5.5}
    episodes = [{"episode": 1, "start_cost": 5.0, **windows}, {"episode": 2, "real_cost": 1.0}]
    assert results.cost_of_learning(episodes, [1.5]) == {"sum": 13.5, "largest": 5.5, "episodes": 6, "judging": [1.5]}
    lines = table.alarm_lines([episode | {"alarm": 1.0, "warning": "the twin is wrong"} for episode in episodes])
    assert lines[0].endswith("in 2 of 2 episodes") and lines[1:] == ["  episode 2: the twin is wrong"]


def test_a_log_names_a_step_that_lasts(monkeypatch, capsys):
    monkeypatch.setattr(dashboard, "QUIET", 0.2)
    monkeypatch.setattr(dashboard, "LONG", 0.7)
    with Progress(1) as bar:
        for step in ("interact", "learn", "plan"):
            bar.doing(step)
        time.sleep(1.2)
    assert capsys.readouterr().err.splitlines() == ["real episode", "planning", "planning, for 1 s"]
