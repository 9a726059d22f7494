"""Runs of every recipe are loaded again, found by what they say, and flown without a training."""

import dataclasses
import json
import runpy
import sys
import typing

import pytest
import torch
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import drawn, stepped
from small_runs import SMALL, small_run
from test_documentation import leave_finished_run
from test_export_recipe import RECIPES, leave_run, leave_run_of, recipe
from test_hypotheses import Suspecting

from rt_torchrl import HypothesesConfig, RunConfig, SaturatedMLP, load_run
from rt_torchrl.runs import settings as settings_module
from rt_torchrl.runs.loaded_run import config_class_of
from rt_torchrl.steps.hypotheses.ensemble import ALONE, TwinEnsemble
from rt_torchrl.steps.switch import clones

PLANTS = ("cryogenic_tank", "flapping_wing", "pendulum", "wind_turbine")


def combinations():
    """Plant, closure and policy: every policy, and every closure."""
    for plant in PLANTS:
        kind = config_class_of(RECIPES / f"{plant}.py")
        hints = typing.get_type_hints(kind)
        (closure, *closures), policies = typing.get_args(hints["closure"]), typing.get_args(hints["policy"])
        yield from ((plant, closure, policy) for policy in policies)
        for further in closures if plant != "pendulum" else ():  # which has no neural closure
            yield plant, further, policies[0]


@pytest.mark.parametrize(("plant", "closure", "policy"), list(combinations()))
def test_every_combination_of_policies_and_closure_is_loaded(plant, closure, policy, tmp_path):
    widths = {"hidden": (3,)} if policy == "mlp" else {}
    config, parts = leave_run(tmp_path, plant, policy=policy, closure=closure, horizon=3000.0, **widths)
    run = load_run(tmp_path)
    assert run.config == config and set(run.policies) == {"model_based", "model_free"} and run.plant.horizon == 3000.0
    for role, part in parts.items():
        found = run.closure if role == "closure" else run.policy(role)
        assert clones(found, part)
    assert isinstance(run.policy("model_free"), SaturatedMLP) >= (policy == "mlp")


ROOM = """
from linear_quadratic import LinearQuadratic
class Room(LinearQuadratic):
    name = "room"
"""
TRAIN = """
import sys
from pathlib import Path
from room import Room
from test_export_recipe import leave_run_of
from rt_torchrl import RunConfig, configuration, load_run
print("runs")
@configuration
class Config(RunConfig):
    horizon: float = 3.0
    def plant(self):
        return Room(horizon=self.horizon)
def main(config):
    folder = Path(sys.argv[1])
    leave_run_of(folder, config, config.plant())
    assert type(load_run(folder).plant) is Room
if __name__ == "__main__":
    main(Config(horizon=2.0))
"""


def test_a_run_of_an_own_script_is_loaded_without_naming_it_and_exported(tmp_path, capsys):
    """The plant lies in a file beside it; both are forgotten again."""
    for name, text in (("room.py", ROOM), ("train.py", TRAIN)):
        (tmp_path / name).write_text(text)
    (tmp_path / "run").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(tmp_path)
        patch.setattr("sys.argv", ["train.py", str(tmp_path / "run")])
        runpy.run_path(str(tmp_path / "train.py"), run_name="__main__")
    del sys.modules["room"]
    assert capsys.readouterr().out == "runs\n"  # load_run has not run the script again that is under way
    run, export = load_run(str(tmp_path / "run")), recipe("export")
    assert run.plant.name == "room" and run.plant.horizon == run.config.horizon == 2.0
    for given in (None, str(tmp_path / "train.py")):
        export.main(export.Config(run=tmp_path / "run", recipe=given, output=tmp_path))
        (tmp_path / "room_model_based.c").unlink()


class Own(RunConfig):
    """A configuration in an importable module, without a plant."""


def test_a_plant_that_no_recipe_makes_is_given(tmp_path, unchecked):
    parts = leave_run_of(tmp_path, Own(), LinearQuadratic())
    with pytest.raises(ValueError, match=r"Own has no method plant\(\).*give load_run the plant"):
        load_run(tmp_path)
    run = load_run(tmp_path, plant=LinearQuadratic())
    with pytest.raises(ValueError, match="policy=<function .* must be an nn.Module from observations to actions"):
        run.simulate(lambda observation: observation[..., :1])
    assert type(run.config) is Own and torch.equal(run.policy("model_free").gain, parts["model_free"].gain)


def name_recipe(folder, file, name="Config"):
    """Let the settings of a run name this recipe."""
    settings = json.loads((folder / "config.json").read_text())
    settings["recipe"] = {"class": name, "file": file}
    (folder / "config.json").write_text(json.dumps(settings))


def test_recipes_that_cannot_be_found_are_told(tmp_path):
    leave_run_of(tmp_path, Own(), LinearQuadratic())
    for name, file, message in (
        ("Config", None, "does not say in which file"),
        ("Config", "/gone.py", "/gone.py does not exist.*If it has moved"),
        ("Path", settings_module.__file__, "Path is no class derived from RunConf"),
    ):
        name_recipe(tmp_path, file, name)
        with pytest.raises(ValueError, match=message):
            load_run(tmp_path, plant=LinearQuadratic())
    with pytest.raises(ValueError, match="config.json is no Python code, by its name; give a file that ends in .py"):
        load_run(tmp_path, str(tmp_path / "config.json"))


CALLED = "open({mark!r}, 'w').close()\nraise SystemExit('code of the run folder')\n"


@pytest.fixture
def evil(tmp_path, monkeypatch):
    """A run folder, the current folder, with code of its own, and a mark that is there once that code has run."""
    folder, mark = tmp_path / "run", tmp_path / "called"
    (folder / "pack").mkdir(parents=True)
    leave_run_of(folder, Own(), LinearQuadratic())
    for name in ("evil.py", "pack/__init__.py", "pack/recipe.py"):
        (folder / name).write_text(CALLED.format(mark=str(mark)))
    (tmp_path / "outside.py").write_text("from rt_torchrl.runs.run_config import RunConfig\nConfig = RunConfig\n")
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend("")
    monkeypatch.syspath_prepend(folder)
    yield folder, mark
    for name in [name for name in sys.modules if name.partition(".")[0] in ("evil", "pack", "rt_torchrl_recipe_out")]:
        del sys.modules[name]


@pytest.mark.parametrize("file", ["evil.py", "pack/recipe.py", "pack/../evil.py"])
def test_a_file_of_the_run_folder_is_not_run(file, evil):
    folder, mark = evil
    for place in (file, str(folder / file)):
        name_recipe(folder, place)
        with pytest.raises(ValueError, match=r"is not run.*give the recipe"):
            load_run(folder, plant=LinearQuadratic())
    assert not mark.exists()


def test_hypotheses_come_back_with_their_closures_and_weights(tmp_path):
    hypotheses = dataclasses.replace(SMALL, hypotheses=HypothesesConfig(call=0.0))
    run = small_run(tmp_path, 1, Suspecting(horizon=2.0), twinning=hypotheses)
    run.train()
    trained = run.algorithm.twin
    loaded = load_run(tmp_path, RunConfig, plant=Suspecting(horizon=2.0))
    assert all(clones(loaded.policy(role), policy) for role, policy in run.algorithm.policies.items())
    found = loaded.twin
    assert isinstance(found, TwinEnsemble) and found.weights == trained.weights
    assert found.twins.keys() == trained.twins.keys() == {ALONE, "late", "lags"}
    for twin in (found, trained):
        twin.weights = {ALONE: 0.5, "late": 0.5}
    policy = run.algorithm.policies["model_based"]
    assert found.cost(policy, *drawn(trained.plant, 2)) == trained.cost(policy, *drawn(trained.plant, 2))
    assert all(clones(found.twins[name].closure, twin.closure) for name, twin in trained.twins.items())
    with pytest.raises(
        ValueError, match=r"hypotheses in .*weights.pt do not fit: plant 'linear_quadratic' suspects no"
    ):
        load_run(tmp_path, RunConfig, plant=LinearQuadratic(horizon=2.0))


# Episodes and figures of a finished run, without a training.


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return load_run(leave_finished_run(tmp_path_factory.mktemp("what_if") / "run"))


def test_an_episode_is_that_of_the_plant_stepped_by_hand(run):
    wind = torch.linspace(9.0, 13.0, 40, dtype=torch.float64)[:, None]
    policy = run.policy("model_based")
    for system, plant, closure in (("real", run.plant, run.plant.closure), ("twin", run.physics, run.closure)):
        flown = run.simulate(policy, wind, on=system, seed=3)
        act = lambda k, t, s, z, plant=plant: policy(plant.observe(t, s, z))  # noqa: E731
        states, *_ = stepped(plant, closure, flown.states[0], wind, act)
        torch.testing.assert_close(flown.states, states, rtol=1e-9, atol=1e-9)


def test_what_is_left_out_is_drawn_and_the_same_seed_is_the_same_episode(run):
    policy = run.policy(run.live)
    one, two, three = (run.simulate(policy, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(one.states, two.states) and not torch.equal(one.exogenous, three.exogenous)
    start = torch.stack([one.states[0], three.states[0]])
    both = run.simulate(policy, torch.stack([one.exogenous, three.exogenous]), start)
    torch.testing.assert_close(both.states, torch.stack([one.states, three.states]), rtol=1e-9, atol=1e-9)


def test_impossible_requests_are_refused(run):
    policy = run.policy("model_based")
    for arguments, message in (
        ({"on": "model"}, "on='model' must be real or twin"),
        ({"exogenous": torch.ones(5, 3)}, r"exogenous of shape \(5, 3\) must have 2 dimensions, the last of 1"),
        ({"initial_state": torch.ones(2)}, r"initial_state of shape \(2,\) must have 1 dimensions, the last of 6"),
        ({"exogenous": torch.ones(2, 5, 1), "initial_state": torch.ones(3, 6)}, "or a batch of 3"),
    ):
        with pytest.raises(ValueError, match=message):
            run.simulate(policy, **arguments)
