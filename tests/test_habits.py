"""Callbacks, early stopping, loggers, files of options, and the summary at the end of a run."""

import csv
import json
import math

import pytest
from linear_quadratic import LinearQuadratic
from small_runs import SMALL, small_run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_export_recipe import RECIPES

from rt_torchrl.runs.callbacks import EarlyStopping
from rt_torchrl.runs.command_line import from_command_line
from rt_torchrl.runs.loaded_run import config_class_of
from rt_torchrl.runs.results_table import SCREEN, next_steps, results_table
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.settings import settings_of
from rt_torchrl.steps.config import PlannerConfig
from rt_torchrl.twinning.config import TwinningConfig

TURBINE = config_class_of(RECIPES / "wind_turbine.py")


def episodes(costs, live="model_based"):
    return [{"live": live, "real_cost": 7.0, "J_a_model_based": cost} for cost in costs]


def test_early_stopping_waits_for_its_patience():
    stop = EarlyStopping(patience=2, least_gain=0.1)
    assert stop(episodes([5.0, 4.0, 3.9])) is None  # one episode without a gain of a tenth
    assert stop(episodes([5.0, 4.0, 3.9, 3.7])) == "no gain of 10 % in the last 2 episodes"
    # Small gains add up to one that counts.
    assert stop(episodes([5.0, 4.0, 3.9, 3.5])) is None
    assert stop(episodes([None, None, 4.0])) is None  # a policy that diverges costs more than any number
    assert stop(episodes([3.0, 2.0, 1.0], live="model_free")) == "no gain of 10 % in the last 2 episodes"


@pytest.mark.parametrize(
    ("arguments", "name"), [({"patience": 0}, "patience=0"), ({"patience": 1, "least_gain": 1.0}, "least_gain=1.0")]
)
def test_impossible_patience_is_refused(arguments, name):
    with pytest.raises(ValueError, match=name):
        EarlyStopping(**arguments)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run of at most four episodes that a callback ends after two, with a CSV logger."""
    folder, seen = tmp_path_factory.mktemp("habits") / "run", []

    def end_after_two(found):
        seen.append(len(found))
        return "two are enough" if len(found) == 2 else None

    config = RunConfig(
        episodes=4, log_dir=folder, unseen=3, untrained=0, figures=False, loggers=("csv",), twinning=SMALL
    )
    metrics = Run(config, LinearQuadratic(horizon=2.0), callbacks=[end_after_two]).train()
    return folder, metrics, seen


def test_a_callback_ends_the_training_and_its_results_are_written(stopped):
    folder, metrics, seen = stopped
    assert seen == [1, 2] and len(metrics["episodes"]) == 2
    assert json.loads((folder / "metrics.json").read_text())["summary"]["cost_of_learning"]["episodes"] == 2


def test_the_csv_logger_has_the_curves_and_the_final_costs(stopped):
    folder, metrics, _ = stopped
    (curve,) = (folder / "csv" / "scalars").rglob("real episode (live policy).csv")
    rows = [(int(step), float(value)) for step, value in csv.reader(curve.open())]
    assert rows == [(k, pytest.approx(episode["real_cost"])) for k, episode in enumerate(metrics["episodes"])]
    (final,) = (folder / "csv" / "scalars" / "final").glob("J_a live.csv")
    live = metrics["summary"]["unseen"][f"J_a_{metrics['summary']['live']}"]["mean"]
    assert float(final.read_text().split(",")[1]) == pytest.approx(live)
    assert "twinning.virtual_episodes: 2" in next((folder / "csv" / "texts").glob("*")).read_text()


def test_tensorboard_has_options_final_costs_and_the_table(stopped):
    folder, metrics, _ = stopped
    events = EventAccumulator(str(folder)).Reload()
    assert "final/J_a live" in events.Tags()["scalars"] and "results/text_summary" in events.Tags()["tensors"]
    content = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    assert b"twinning.virtual_episodes" in content


def test_unknown_loggers_and_missing_packages_are_refused(monkeypatch):
    with pytest.raises(SystemExit):
        from_command_line(TURBINE, ["--loggers", "excel"])
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match="loggers='wandb' needs a package that is not installed: pip install wandb"):
        RunConfig(loggers=("wandb",))


def test_the_options_of_a_run_run_again(tmp_path):
    asked = from_command_line(TURBINE, ["--policy", "bias", "--seed", "3", "--log-dir", str(tmp_path), "--overwrite"])
    file = tmp_path / "config.json"
    file.write_text(json.dumps(settings_of(asked, "wind_turbine") | {"ran": []}, default=str))
    again = from_command_line(TURBINE, ["--config", str(file), "--seed", "4"])
    assert (again.policy, again.seed, again.twinning) == ("bias", 4, asked.twinning)
    assert (again.log_dir, again.overwrite, again.config) == (None, False, file)


def test_a_file_may_hold_a_few_options(tmp_path):
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"episodes": 7, "twinning": {"planner": {"iterations": 3}}}))
    found, default = from_command_line(TURBINE, ["--config", str(file)]), from_command_line(TURBINE, [])
    assert (found.episodes, found.twinning.planner.iterations) == (7, 3)
    assert found.twinning.planner.realisations == default.twinning.planner.realisations == 50


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "config=.*cannot be read"),
        ("[1]", "must hold an object"),
        ('{"epsodes": 3}', "has no option epsodes"),
        ('{"episodes": 0}', "episodes=0 must be at least 1"),
        ("[" * 100_000, "config=.*cannot be read: maximum recursion depth"),
        ('{"twinning": ' * 100_000, "config=.*cannot be read: maximum recursion depth"),
        ('\ufeff{"episodes": 3}', "config=.*byte-order mark; save it as UTF-8 without one"),
        ('{"recipe": "x"}', "config=.*its recipe is 'x'; it must be an object"),
        ('{"recipe": 0}', "config=.*its recipe is 0; it must be an object"),
        ('{"recipe": {"file": 3}}', "config=.*its recipe is .*it must be an object"),
        ('{"recipe": {"file": "/a/flapping_wing.py"}}', "is of the recipe flapping_wing.py, not of wind_turbine.py"),
    ],
)
def test_a_file_that_cannot_be_carried_out_is_refused(content, message, tmp_path):
    file = tmp_path / "config.json"
    file.write_text(content, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        from_command_line(TURBINE, ["--config", str(file)])


def many_weights(metrics, count):
    """Results as those of a plant with a classical controller, five merits and a closure of many weights."""
    merit = {f"quantity {k}": {"mean": 1.0, "median": 1.0} for k in range(5)}
    cost = {"mean": 2.0, "confidence_interval": [1.0, 3.0]}
    unseen = metrics["summary"]["unseen"] | {"merit": dict.fromkeys(("model_based", "model_free"), merit)}
    unseen |= {"baselines": {"PI": {"J_a": cost, "merit": merit}}, "categories": {}}
    start = {f"c{k}": 1.0 for k in range(count)}
    found = start | {"c3": 2.0, "c5": 1.5, "c7": None}
    closure = {"start": start, "found": found, "true": {}, "described": {}}
    return metrics | {"summary": metrics["summary"] | {"unseen": unseen, "closure": closure}}


def test_the_summary_fits_one_screen_and_shows_the_weights_that_changed(stopped, tmp_path):
    metrics = many_weights(stopped[1], 40)
    shown = results_table(metrics).splitlines() + ["results in …"] + next_steps(metrics, tmp_path).splitlines()
    assert len(shown) <= SCREEN + 1  # the first line is empty
    assert all(any(line.split()[:1] == [name] for line in shown) for name in ("c3", "c5", "c7"))
    assert any("more, which have changed less, are in metrics.json" in line for line in shown)


def test_the_next_step_follows_from_the_results(stopped, tmp_path):
    metrics = stopped[1]
    live = metrics["summary"]["live"]
    cost = metrics["summary"]["unseen"][f"J_a_{live}"]["mean"]

    def said(better, controller, planner=None, **summary):
        unseen = metrics["summary"]["unseen"] | {"baselines": {"PI": {"J_a": {"mean": controller}}}}
        found = metrics["summary"] | {"unseen": unseen, "better": better} | summary
        config = TURBINE(twinning=TwinningConfig(planner=PlannerConfig(method=planner)))
        return next_steps({"summary": found}, tmp_path, config)

    other = {"model_based": "model_free", "model_free": "model_based"}[live]
    assert "recipes/export.py" in said(live, 2.0 * cost)
    assert "PI is better than the live policy" in said(live, 0.5 * cost)
    assert f"({other.replace('_', '-')}): export that role" in said(other, 2.0 * cost)
    assert said("model_free", math.inf, live="model_free").endswith("--role model_free")
    planned = said("model_based", math.inf, "receding_horizon", live="model_based")
    assert planned.endswith("--what twin")
    beside = said("model_based", math.inf, "receding_horizon", live="model_based", believed="lags")
    assert "the model that it plans on" in planned and "the twin with lags, on which it does not plan," in beside


def test_a_small_run_ends_early_by_its_option(tmp_path, monkeypatch):
    monkeypatch.setattr(EarlyStopping, "cost", staticmethod(lambda episode: 1.0))
    metrics = small_run(tmp_path / "run", episodes=4, patience=1, untrained=0).train()
    assert len(metrics["episodes"]) == 2
