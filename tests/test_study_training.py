"""Trainings of the study: their commands, what counts as finished, and the recipes' options for their variants."""

import json
from pathlib import Path

import pytest
import tyro
from handwritten_study import WRITE_RESULTS, finished, recipe, training, written

from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.study.scheduling import on_this_machine
from rt_torchrl.study.training import VARIANTS


def test_the_command_of_a_training_can_be_repeated_by_hand(tmp_path):
    found = training(tmp_path, 3, variant="noise 1 %", options=("--quick",))
    command = found.command()
    assert "some_plant.py --seed 3 --twinning.arm twinning" in command and "--noise 0.01 --quick" in command
    assert "--overwrite" in command and "--resume" not in command
    found.folder.mkdir()
    (found.folder / "checkpoint.pt").touch()
    assert "--resume" in found.command() and "--overwrite" not in found.command()
    with pytest.raises(ValueError, match="variant='rain' does not exist; choose one of nominal"):
        training(tmp_path, variant="rain")


def test_a_failed_training_says_why_and_a_finished_one_is_kept(tmp_path):
    failing = training(tmp_path, recipe=written(tmp_path / "fails.py", "raise ValueError('no rotor')"))
    with pytest.raises(RuntimeError, match="fails.py --seed 0 .* failed; see .*training.log: no rotor"):
        failing.run()
    assert "fails.py --seed 0" in (failing.folder / "training.log").read_text()
    results = json.dumps({"summary": {}, "episodes": [{}] * 3})
    (failing.folder / "metrics.json").write_text(results)
    failing.run()
    assert (failing.folder / "metrics.json").read_text() == results


def test_a_training_needs_a_recipe(tmp_path):
    with pytest.raises(RuntimeError, match="some_plant.py does not exist"):
        training(tmp_path).run()
    (tmp_path / "bare.py").write_text("x = 1")
    with pytest.raises(RuntimeError, match="has no class Config"):
        training(tmp_path, recipe=tmp_path / "bare.py").run()


@pytest.mark.parametrize("plant", ["wind_turbine", "flapping_wing", "cryogenic_tank"])
def test_every_variant_is_an_option_of_every_recipe(plant):
    config = recipe(plant).Config
    nominal = tyro.cli(config, args=[])
    for name, options in VARIANTS.items():
        harder = tyro.cli(config, args=list(options))
        assert (harder == nominal) == (name == "nominal")
        assert harder.model_error == (name == "model error")


@pytest.mark.parametrize(
    "content", ["", '{"episodes": [', "{}", "null", "[1]", '{"episodes": 3, "summary": {}}', "\0\0"]
)
def test_a_damaged_metrics_file_is_no_finished_training(tmp_path, content):
    found = finished(tmp_path, 0, 0.0)
    assert found.done()
    (found.folder / "metrics.json").write_text(content)
    assert not found.done()
    with pytest.raises(ValueError, match=r"seed-0 holds no results of a training of 3 episodes; run the study again"):
        found.metrics()


def test_a_training_that_was_cut_short_is_not_finished(tmp_path):
    """An interrupted run judges the episodes that it has done, and writes their results."""
    found = finished(tmp_path, 0, 0.0)
    metrics = found.metrics()
    (found.folder / "metrics.json").write_text(json.dumps(metrics | {"episodes": metrics["episodes"][:2]}))
    assert not found.done()


def test_an_interrupted_training_ends_the_study(tmp_path):
    """Its recipe takes the signal and ends well, with the results of the episodes that it has done."""
    fewer = WRITE_RESULTS.replace("config.episodes", "(config.episodes - 1)")
    assert fewer != WRITE_RESULTS
    cut_short = training(tmp_path, recipe=written(tmp_path / "cut_short.py", fewer))
    following = training(tmp_path, 1, recipe=written(tmp_path / "tiny.py", WRITE_RESULTS))
    with pytest.raises(KeyboardInterrupt):
        on_this_machine([cut_short, following], jobs=1)
    assert not following.folder.exists()
    assert not cut_short.done()


PRESSED = """
import os, signal
from unittest.mock import patch
from small_recipe import Config, main as train
from rt_torchrl.algorithm import ReinforcementTwinning

INTERACT = ReinforcementTwinning.interact

def pressed(algorithm):
    os.kill(os.getpid(), signal.SIGNAL)
    return INTERACT(algorithm)

def main(config):
    with patch.object(ReinforcementTwinning, "interact", pressed):
        train(config)
"""
"""A recipe that is interrupted in its first episode."""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_training_that_is_interrupted_in_its_first_episode_ends_the_study(tmp_path, name):
    """It has nothing to report, which is no failure; by hand the recipe says so."""
    path = tmp_path / "pressed.py"
    path.write_text(PRESSED.replace("SIGNAL", name))
    pressed, following = (training(tmp_path, seed, recipe=path) for seed in (0, 1))
    with pytest.raises(KeyboardInterrupt):
        on_this_machine([pressed, following], jobs=1)
    assert (pressed.folder / "config.json").exists() and not following.folder.exists()
    found = load_recipe(path)
    with pytest.raises(SystemExit, match="^interrupted before the first episode was done; nothing to report.$"):
        found.main(from_command_line(found.Config, pressed.arguments()))


def test_results_of_other_options_are_refused(tmp_path):
    """A page must not mix results of 3 unseen episodes with those of 4, or of two learners."""
    kept = {"recipe": Path(__file__).with_name("small_recipe.py"), "episodes": 1}
    found = training(tmp_path, **kept, options=("--compiled", "False", "--unseen", "3"))
    found.run()
    assert found.done() and training(tmp_path, **kept, options=("--unseen", "3", "--patience", "2")).done()
    metrics = (found.folder / "metrics.json").read_bytes()
    for options, said in (
        (("--unseen", "4"), "unseen is 4 here and was 3 in the run"),
        (("--twinning.learner.discount", "0.9"), "twinning.learner.discount is 0.9 here and was 0.98 in the run"),
    ):
        other, following = (training(tmp_path, seed, **kept, options=options) for seed in (0, 1))
        for ask in (other.done, other.run, lambda tasks=[following, other]: on_this_machine(tasks, 1)):
            with pytest.raises(ValueError, match=f"seed-0 holds the results of other options: {said}. Give the opt"):
                ask()
        assert not following.folder.exists()
    assert (found.folder / "metrics.json").read_bytes() == metrics
    (found.folder / "config.json").unlink()
    assert other.done()  # results by hand


def test_a_training_with_damaged_results_runs_again(tmp_path):
    found = training(tmp_path, recipe=written(tmp_path / "tiny.py", WRITE_RESULTS))
    found.folder.mkdir()
    (found.folder / "metrics.json").write_text("")
    found.run()
    assert found.done() and len(found.metrics()["episodes"]) == 3


def test_a_recipe_that_ends_without_results_fails(tmp_path):
    with pytest.raises(
        RuntimeError, match=r"quiet.py --seed 0 .* ended without the results of 3 episodes; see .*\.log"
    ):
        training(tmp_path, recipe=written(tmp_path / "quiet.py", "pass")).run()
