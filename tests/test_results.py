"""Results of a run: numbers, tables, its bar, loggers, callbacks and files of options."""

import dataclasses
import json
import math
import re
import sys
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
from rt_torchrl.runs import dashboard, results
from rt_torchrl.runs.command_line import from_command_line
from rt_torchrl.runs.dashboard import Progress
from rt_torchrl.runs.loaded_run import config_class_of
from rt_torchrl.runs.metrics import read_metrics
from rt_torchrl.runs.results import (
    alarm_lines,
    closure_lines,
    cost_of_learning,
    dearer_than_first,
    fit_lines,
    next_steps,
    results_table,
)
from rt_torchrl.runs.results import progress as progress_line
from rt_torchrl.runs.settings import settings_of


def test_metrics_are_json_where_nothing_was_iterated(tmp_path, capsys):
    nothing = {part: dataclasses.replace(getattr(SMALL, part), iterations=0) for part in ("assimilation", "planner")}
    twinning = dataclasses.replace(SMALL, **nothing)
    metrics = small_run(tmp_path, 1, twinning=twinning).train()
    assert json.loads((tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail) == metrics
    assert metrics["episodes"][0]["J_p"] is None and metrics["episodes"][0]["real_cost"] > 0.0
    assert "J_a model-based" in capsys.readouterr().out


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


# The closure's weights on the terminal.


ROD = {"a": {"unit": "kg", "meaning": "mass of the rod"}}


@pytest.mark.parametrize(
    ("known", "errors", "columns", "rows"),
    [
        ({}, None, "", ["a 1 1.5", "b 2 2.5"]),
        ({"true": {"other": 1.0}}, None, "", ["a 1 1.5", "b 2 2.5"]),
        ({"true": {"a": 1.25}}, {"a": 0.25, "b": None}, " std. error true", ["a 1 1.5 0.25 1.25", "b 2 2.5 - -"]),
        ({}, {"a": 0.0, "b": 0.5}, " std. error", ["a 1 1.5 fixed", "b 2 2.5 0.5"]),
        ({"described": ROD}, None, "", ["a [kg] 1 1.5 mass of the rod", "b 2 2.5"]),
    ],
)
def test_weights_are_shown_with_what_is_known_of_them(known, errors, columns, rows):
    closure = {"start": {"a": 1.0, "b": 2.0}, "found": {"a": 1.5, "b": 2.5}, "described": {}} | known
    shown = [" ".join(line.split()) for line in closure_lines(closure, errors=errors)]
    legend = "std. error -: the records say nothing of the weight alone, at most of combinations with others"
    unknown = errors is not None and None in errors.values()
    assert shown == [f"closure weight start found{columns}", *rows, *[legend][: int(unknown)]]


# The bar of a training says what is under way.


def test_it_names_each_step_as_it_begins():
    told = []
    twinning().episode(told.append)
    assert told == STEPS and set(dashboard.WORDS) == {"start", *STEPS}


def test_it_shows_the_step_and_the_costs_of_the_last_episode(monkeypatch, capsys):
    with monkeypatch.context() as terminal:
        terminal.setattr(sys.stderr, "isatty", lambda: True)
        with Progress(3) as bar:
            bar.doing("assimilate")
            bar.episode({"episode": 1, "real_cost": 0.25, "live": "model_free"})
            bar.doing("drawing figures")
    shown = capsys.readouterr().err
    assert "assimilating" in shown and "1/3" in shown and "real 0.25, live model-free; drawing figures" in shown


def test_it_says_why_no_policy_may_act(capsys):
    with Progress(2) as bar:
        bar.episode({"episode": 1, "real_cost": 0.25, "live": "first", "reason": "model_based may not act: it is dear"})
    assert "episode 1: model_based may not act: it is dear" in capsys.readouterr().out


def test_a_log_has_a_line_for_each_episode_and_for_what_begins_after_a_while(monkeypatch, capsys):
    with Progress(3) as bar:
        bar.doing("checking the gradient")
        bar.doing("assimilate")
        bar.episode({"episode": 1, "real_cost": 0.25, "live": "model_free"})
        monkeypatch.setattr(dashboard, "QUIET", 0.0)
        bar.doing("plan")
    expected = ["checking the gradient", "episode 1/3: real 0.25, live model-free", "planning"]
    assert capsys.readouterr().err.splitlines() == expected


def test_it_says_when_another_twin_is_believed(capsys):
    record = {"real_cost": 0.25, "live": "model_free", "J_p": 1.0}
    with Progress(4) as bar:
        for episode, believed in enumerate((None, "pitch lag, late by 3", "pitch lag, late by 3", None), 1):
            bar.episode(record | {"episode": episode, "believed": believed})
    lines = [line.strip() for line in capsys.readouterr().out.splitlines() if "is the likeliest" in line]
    assert lines == [
        "episode 2: the twin with 'pitch lag, late by 3' is the likeliest; J_p and closure are its own",
        "episode 4: the twin alone is the likeliest; J_p and closure are its own",
    ]


# Callbacks, early stopping, files of options, and the summary at the end of a run.


TURBINE = config_class_of(RECIPES / "wind_turbine.py")


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run of at most four episodes that a callback ends after two."""
    folder, seen = tmp_path_factory.mktemp("habits") / "run", []

    def end_after_two(found):
        seen.append(len(found))
        return "two are enough" if len(found) == 2 else None

    metrics = small_run(folder, 4, parts={"callbacks": [end_after_two]}).train()
    return folder, metrics, seen


def test_tensorboard_has_the_final_costs_and_the_table(stopped):
    tags = EventAccumulator(str(stopped[0])).Reload().Tags()
    assert {"unseen episodes/J_p", "unseen episodes/J_a model_based"} <= set(tags["histograms"])
    assert any(name.startswith("model_free/") for name in tags["histograms"])
    assert "final/J_a live" in tags["scalars"] and "results/text_summary" in tags["tensors"]


def test_a_run_goes_on_with_its_own_options(tmp_path):
    """The seed and a preset need not be said again, and what is said beside replaces what the run had."""
    asked = from_command_line(TURBINE, ["--preset", "paper", "--seed", "3", "--log-dir", str(tmp_path)])
    (tmp_path / "config.json").write_text(json.dumps(settings_of(asked, "wind_turbine"), default=str))
    again = from_command_line(TURBINE, ["--resume", "--log-dir", str(tmp_path), "--episodes", "30"])
    assert again == dataclasses.replace(asked, resume=True, episodes=30)


def test_the_options_of_a_run_run_again(tmp_path):
    asked = from_command_line(TURBINE, ["--policy", "bias", "--seed", "3", "--log-dir", str(tmp_path)])
    file = tmp_path / "config.json"
    file.write_text(json.dumps(settings_of(asked, "wind_turbine") | {"ran": []}, default=str))
    again = from_command_line(TURBINE, ["--config", str(file), "--seed", "4"])
    assert (again.policy, again.seed, again.twinning) == ("bias", 4, asked.twinning)
    assert (again.log_dir, again.config) == (None, file)


def test_a_file_may_hold_a_few_options(tmp_path):
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"episodes": 7, "twinning": {"planner": {"iterations": 3}}}))
    found, default = from_command_line(TURBINE, ["--config", str(file)]), from_command_line(TURBINE, [])
    assert (found.episodes, found.twinning.planner.iterations) == (7, 3)
    assert found.twinning.planner.realisations == default.twinning.planner.realisations == 50


def many_weights(metrics, count):
    """Results as those of a plant with a classical controller, five merits and a closure of many weights."""
    merit = {f"quantity {k}": {"mean": 1.0, "median": 1.0} for k in range(5)}
    cost = {"mean": 2.0, "confidence_interval": [1.0, 3.0]}
    unseen = metrics["summary"]["unseen"] | {"merit": dict.fromkeys(("model_based", "model_free"), merit)}
    unseen |= {"baselines": {"PI": {"J_a": cost, "merit": merit, "ratio": cost, "cheaper": 0}}}
    start = {f"c{k}": 1.0 for k in range(count)}
    found = start | {"c3": 2.0, "c5": 1.5, "c7": None}
    closure = {"start": start, "found": found, "true": {}, "described": {}}
    return metrics | {"summary": metrics["summary"] | {"unseen": unseen, "closure": closure}}


@pytest.mark.parametrize(("count", "rows"), [(12, 12), (40, 0)])
def test_the_summary_shows_the_weights_of_a_small_closure(stopped, count, rows):
    shown = results_table(many_weights(stopped[1], count))
    assert len(re.findall(r"(?m)^  c\d+ ", shown)) == rows
    assert ("closure: 40 weights, in metrics.json" in shown) == (rows == 0)


def test_the_next_step_follows_from_the_results(stopped, tmp_path):
    metrics = stopped[1]
    live = metrics["summary"]["live"]
    cost = metrics["summary"]["unseen"][f"J_a_{live}"]["mean"]

    def said(better, controller, planner="multi_start", place="simulation", **summary):
        unseen = metrics["summary"]["unseen"] | {"judged_on": place, "baselines": {"PI": {"J_a": {"mean": controller}}}}
        found = metrics["summary"] | {"unseen": unseen, "better": better} | summary
        config = TURBINE(twinning=TwinningConfig(planner=PlannerConfig(method=planner)))
        return next_steps({"summary": found}, tmp_path, config)

    other = {"model_based": "model_free", "model_free": "model_based"}[live]
    assert "recipes/export.py" in said(live, 2.0 * cost)
    assert "PI is better than the live policy" in said(live, 0.5 * cost)
    assert f"({other.replace('_', '-')}): export that role" in said(other, 2.0 * cost)
    first = {"expected": 3.0, "paid": 2.0}
    told = said(live, 2.0 * cost, place="twin", first=first)
    assert "the controller that flew first is better than the live policy" in told
    assert "recipes/export.py" in said(live, 2.0 * cost, place="twin", first={"expected": 2.0, "paid": 3.0})
    assert "recipes/export.py" in said(live, 2.0 * cost, first=first)  # other episodes tell more
    assert dearer_than_first({"first": first | {"expected": None}}).startswith(
        "the live policy is expected to cost - on"
    )
    assert said("model_free", math.inf, live="model_free").endswith("--role model_free")
    planned = said("model_based", math.inf, "receding_horizon", live="model_based")
    assert planned.endswith("--what twin")


def test_errors_of_the_twin_are_told_in_units_over_what_was_fitted():
    rms = {"rotor_speed [rad/s]": 0.0123456, "shares [-]": None, "height [m]": 2.0}
    found = {"rms": rms, "segment": 0, "standard_errors": {}}
    line = "RMS rotor_speed 0.0123 rad/s, shares diverges, height 2 m"
    assert fit_lines(found) == [f"  twin over its last records: {line}"]
    assert fit_lines(found | {"segment": 22}) == [f"  twin over segments of 22 intervals: {line}"]
    assert fit_lines({"rms": {}, "segment": 0, "standard_errors": {}}) == []
    record = {"J_p": 1.0, "real_cost": 0.5, "live": "model_free"}
    record |= {f"rms/{name}": value for name, value in rms.items()}
    assert progress_line(record) == "RMS rotor_speed 0.0123 rad/s, shares diverges, real 0.5, live model-free"


def test_every_window_is_paid_and_episodes_are_counted_from_one():
    episodes = [{"episode": 1, "start_cost": 5.0, "real_cost": 2.0, "windows": 3.0}, {"episode": 2, "real_cost": 1.0}]
    assert cost_of_learning(episodes, [1.5]) == {"sum": 13.5, "largest": 5.0, "episodes": 6, "judging": [1.5]}
    lines = alarm_lines([episode | {"alarm": 1.0, "warning": "the twin is wrong"} for episode in episodes])
    assert lines[0].endswith("in 2 of 2 episodes") and lines[1:] == ["  episode 2: the twin is wrong"]


@pytest.mark.parametrize(("episodes", "summary"), [({}, {}), ([1], {}), ([], None), (None, {})])
def test_results_of_another_shape_are_refused(tmp_path, episodes, summary):
    (tmp_path / "metrics.json").write_text(json.dumps({"episodes": episodes, "summary": summary}))
    message = (
        r"metrics\.json is damaged: it must be an object with episodes, a list of objects, and summary, an object\."
    )
    with pytest.raises(ValueError, match=message):
        read_metrics(tmp_path)
    (tmp_path / "metrics.json").write_text(json.dumps({"episodes": [], "summary": {"live": "pilot"}}))
    message = r"metrics\.json is damaged: summary names the live policy 'pilot'; it must be model_based or model_free"
    with pytest.raises(ValueError, match=message):
        read_metrics(tmp_path)
