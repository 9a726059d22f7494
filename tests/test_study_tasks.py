"""Tasks of the study: trainings, yardsticks, and their processes."""

import json
import os
import time
from functools import partial
from pathlib import Path

import pytest
import torch
import tyro
from handwritten_study import RECIPES, WRITE_RESULTS, finished, recipe, training, written

from rt_torchrl.envs.cryogenic_tank.controllers import PIValve
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.evaluation.unseen import UNSEEN_SEED, UnseenEpisodes
from rt_torchrl.runs.command_line import from_command_line, load_recipe, shipped_plants
from rt_torchrl.study import scheduling, yardsticks
from rt_torchrl.study.results import yardstick_entry
from rt_torchrl.study.scheduling import on_this_machine, side_by_side
from rt_torchrl.study.training import VARIANTS
from rt_torchrl.study.yardstick import Yardstick
from rt_torchrl.study.yardsticks import (
    changed_closure,
    classical,
    configured,
    cost_over_episodes,
    least_cost,
    predictive_control,
)


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
from rt_torchrl.steps.interact import Interact

FORWARD = Interact.forward

def pressed(step, episode):
    os.kill(os.getpid(), signal.SIGNAL)
    return FORWARD(step, episode)

def main(config):
    with patch.object(Interact, "forward", pressed):
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


# The study's tasks side by side: processes, progress and failures.


def test_trainings_run_side_by_side(tmp_path):
    script = written(tmp_path / "tiny.py", WRITE_RESULTS)
    trainings = [training(tmp_path, seed, recipe=script) for seed in range(2)]
    side_by_side([[task] for task in trainings], jobs=2)
    assert os.getpid() not in [t.metrics()["process"] for t in trainings]


class Counted:
    """A task that writes a file when it is run."""

    def __init__(self, path):
        self.path = path

    def run(self):
        with self.path.open("a") as file:
            file.write(f"{os.getpid()}\n")

    def done(self):
        return self.path.exists()


def test_a_batch_runs_in_one_process_and_the_bar_counts_tasks(tmp_path, capsys):
    batches = [[Counted(tmp_path / f"{batch}-{task}") for task in range(3)] for batch in range(2)]
    batches[0][0].run()
    side_by_side(batches, jobs=2)
    workers = [[task.path.read_text().split()[-1] for task in batch] for batch in batches]
    assert all(len(set(found)) == 1 for found in workers)
    shown = capsys.readouterr().err
    assert "1/6" in shown and "6/6" in shown


class Slow(Counted):
    """A task that takes several glances of the bar."""

    def run(self):
        time.sleep(0.3)
        super().run()


def test_the_bar_moves_inside_a_batch(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(scheduling, "GLANCE", 0.05)
    side_by_side([[Slow(tmp_path / str(task)) for task in range(3)]], jobs=1)
    shown = capsys.readouterr().err
    assert all(f"{done}/3" in shown for done in range(4))


def test_a_task_that_fails_stops_no_other(tmp_path):
    failing = training(tmp_path, 7, recipe=written(tmp_path / "fails.py", "raise ValueError('no rotor')"))
    others = [Counted(tmp_path / "first"), Counted(tmp_path / "second")]
    with pytest.raises(RuntimeError, match=r"1 failed, the others are kept:\nRuntimeError: .*fails.py .* no rotor"):
        side_by_side([[failing, others[0]], [others[1]]], jobs=1)
    assert all(task.done() for task in others)


class Leaving(Counted):
    """A task that ends the process, as a command line with an unknown option does."""

    def run(self):
        raise SystemExit(2)


def test_a_task_that_leaves_stops_no_other(tmp_path):
    other = Counted(tmp_path / "other")
    with pytest.raises(RuntimeError, match=r"1 failed, the others are kept:\nSystemExit: 2"):
        side_by_side([[Leaving(tmp_path / "leaving"), other]], jobs=1)
    assert other.done()


# Yardsticks of the study: what is kept, and on what they are measured.


def test_what_is_kept_is_not_computed_again(tmp_path):
    calls = []
    yardstick = Yardstick(tmp_path / "deep" / "x.json", lambda: calls.append(1) or {"costs": [1.0]})
    for _ in range(2):
        assert yardstick.done() == bool(calls)
        assert yardstick.run() == {"costs": [1.0], "arguments": {}}
    assert len(calls) == 1


def test_what_is_of_other_arguments_is_computed_again(tmp_path):
    """The folder of the recipe does not count; what an earlier version has kept has no arguments."""

    def compute(recipe, kind, *, starts):
        return {"starts": starts}

    few, many, elsewhere = (
        Yardstick(tmp_path / "x.json", partial(compute, Path(folder) / "plant.py", PIValve, starts=starts))
        for folder, starts in (("here", 2), ("here", 5), ("there", 2))
    )
    assert few.run()["starts"] == 2 and elsewhere.done() and not many.done()
    with pytest.warns(UserWarning, match=r"x\.json is of other arguments; what it held is computed again"):
        assert many.run()["starts"] == 5
    assert many.done() and not few.done()
    many.path.write_text('{"starts": 5}')
    assert few.done() and many.done()


@pytest.mark.parametrize("left", ["", '{"costs": [1.0', "null"])
def test_a_damaged_yardstick_is_computed_again(tmp_path, left):
    yardstick = Yardstick(tmp_path / "x.json", lambda: {"costs": [1.0]})
    yardstick.path.write_text(left)
    assert not yardstick.done()
    with pytest.warns(UserWarning, match=r"x\.json is damaged; what it held is computed again"):
        assert yardstick.run()["costs"] == [1.0]
    assert yardstick.done()


def test_a_system_with_model_error_ends_as_its_recipe_says():
    turbine, drone, tank = (shipped_plants()[name]() for name in ("wind_turbine", "flapping_wing", "cryogenic_tank"))
    recipes = [RECIPES / f"{name}.py" for name in ("wind_turbine", "flapping_wing", "cryogenic_tank")]
    worn = changed_closure(turbine, recipes[0], ())
    speeds, pitch = torch.tensor([[7.6]], dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    features = torch.cat([speeds, pitch], -1)
    assert worn(features).item() < 0.95 * turbine.closure(features).item()
    # The drone's real body is the plant's own; it is the twin that believes in a lighter one.
    assert changed_closure(drone, recipes[1], ()) is None
    fouled = changed_closure(tank, recipes[2], ("--episodes", "11"))
    ratio = fouled.log_coefficients.exp() / tank.closure.log_coefficients.exp()
    assert ratio.tolist() == pytest.approx([1.0, 0.98**10, 1.0])


def test_a_classical_controller_is_judged_on_what_its_twin_does_not_know(monkeypatch):
    monkeypatch.setattr(yardsticks, "missing_for_compilation", lambda: "a compiler")
    short = ("--horizon", "7500", "--command", "drop", "--end-weight", "0")
    size = {"unseen": 3, "episodes": 2, "evaluations": 3, "changed": False}
    as_known, real = (
        classical(RECIPES / "cryogenic_tank.py", (*short, *further), PIValve, **size)
        for further in ((), ("--unknown", "bias_15"))
    )
    assert "changed" not in real  # model error would be another real system
    plant = configured(RECIPES / "cryogenic_tank.py", (*short, "--unknown", "bias_15")).plant()
    episodes = UnseenEpisodes(plant, 3)
    valve = PIValve(configured(RECIPES / "cryogenic_tank.py", short).plant(), tuple(real["gains"].values()))
    assert real["costs"] == pytest.approx(episodes.judge(episodes.fly_baseline(valve)).control_costs.tolist())
    assert real["costs"] != pytest.approx(as_known["costs"], rel=0.01)


def test_a_plan_on_training_episodes_is_judged_on_unseen_ones(monkeypatch):
    monkeypatch.setattr(yardsticks, "missing_for_compilation", lambda: "a compiler")
    system = RECIPES / "wind_turbine.py", ("--horizon", "5", "--policy", "paper")
    planned = {n: cost_over_episodes(*system, unseen=4, counts=(2, 3), iterations=n) for n in (0, 8)}
    plant = configured(*system).plant()
    start = plant.make_policy(torch.Generator().manual_seed(UNSEEN_SEED))
    assert planned[0]["costs"] == pytest.approx([UnseenEpisodes(plant, 4).control_costs(start).mean().item()] * 2)
    assert planned[8]["values"] == [2, 3] and max(planned[8]["costs"]) < planned[0]["costs"][0]


def test_the_limit_is_below_predictive_control_on_the_first_unseen_episodes(monkeypatch):
    monkeypatch.setattr(yardsticks, "missing_for_compilation", lambda: "a compiler")
    system = RECIPES / "wind_turbine.py", ("--horizon", "15", "--policy", "paper")
    best = least_cost(*system, unseen=4, count=2, iterations=3000)
    planned = predictive_control(*system, unseen=4, count=2)
    assert all(low < high for low, high in zip(best["costs"], planned["costs"], strict=True))
    assert len(best["costs"]) == 2 and best["details"]["projected_gradient"] < 1e-2
    assert best["milliseconds"] is None and planned["milliseconds"]["median"] > 0.0
    episodes = UnseenEpisodes(configured(*system).plant(), 4).first(2)
    jonkman = episodes.judge(episodes.fly_baseline(JonkmanController(episodes.plant)))
    assert set(best["merit"]) == set(jonkman.merit) and max(best["costs"]) < jonkman.control_costs.max()
    entry = yardstick_entry("mpc", planned)
    assert entry.milliseconds == planned["milliseconds"]["median"] and entry.over(yardstick_entry("limit", best)) > 1.0


def test_what_a_recipe_does_not_say_is_refused():
    with pytest.raises(ValueError, match="no model predictive control with the options --command drop"):
        predictive_control(RECIPES / "cryogenic_tank.py", ("--command", "drop", "--horizon", "3000"), unseen=2, count=2)
    with pytest.raises(ValueError, match="does not say how the limit is computed"):
        least_cost(RECIPES / "pendulum.py", (), unseen=2, count=2, iterations=1)


def test_yardsticks_are_measured_on_the_plant_of_the_trainings():
    short = configured(RECIPES / "flapping_wing.py", ("--quick", "--horizon", "1.25"))
    assert short.plant().horizon == pytest.approx(1.25) and short.episodes == 3
    for name, default in shipped_plants().items():
        if (RECIPES / f"{name}.py").exists() and name != "cascaded_tanks":  # whose recipe trains on a record alone
            assert configured(RECIPES / f"{name}.py", ()).plant().extra_repr() == default().extra_repr()
