"""Options of configurations and recipes: presets, bounds, and what a command line tells in one line."""

import dataclasses
import importlib
import re
import sys
from pathlib import Path

import pytest
import torch
from test_export_recipe import RECIPES

from rt_torchrl import Plant, RunConfig, rk4_step
from rt_torchrl.options import configuration, read_options
from rt_torchrl.runs.command_line import from_command_line, load_recipe, main_of
from rt_torchrl.runs.loaded_run import config_class_of


def of_command_line(plant, *words):
    return from_command_line(config_class_of(RECIPES / f"{plant}.py"), words)


PLANTS = {
    "wind_turbine": ("--start", "random"),
    "flapping_wing": ("--start", "random"),
    "cryogenic_tank": ("--start", "random", "--command", "drop", "--end-weight", "0"),
}
ROWS = {"wind_turbine": "T1", "flapping_wing": "T2", "cryogenic_tank": "T3"}


@pytest.mark.parametrize("plant", PLANTS)
def test_the_paper_is_one_option(plant):
    """Its policy, observations, cost and numbers of gradients; the other defaults are apart from them."""
    made, paper = load_recipe(RECIPES / f"{plant}.py"), of_command_line(plant, "--preset", "paper")
    row = getattr(made, f"PAPER_{ROWS[plant]}")
    usual = of_command_line(plant)
    assert paper.twinning == row != made.DEFAULT == usual.twinning
    assert [config.effective().twinning.exploration.noise for config in (usual, paper)] == [0.0, 0.2]
    spelled = of_command_line(plant, "--policy", "paper", "--observe", "paper", *PLANTS[plant])
    assert dataclasses.replace(spelled, preset="paper", observe=(), twinning=row) == paper
    assert paper.plant().observations == spelled.plant().observations and paper.plant().cost == spelled.plant().cost
    default = of_command_line(plant).plant()
    assert (default.observations, default.actions) != (paper.plant().observations, paper.plant().actions)


@pytest.mark.parametrize("plant", PLANTS)
def test_options_that_are_given_hold_with_a_preset_too(plant):
    asked = "--preset", "paper", "--policy", "mlp", "--closure", "mlp", "--twinning.planner.iterations", "7"
    found = of_command_line(plant, *asked)
    assert found.policy == "mlp" and found.twinning.planner.iterations == 7 and found.closure == "mlp"
    assert found.plant().observations == of_command_line(plant, "--preset", "paper").plant().observations


@pytest.mark.parametrize("plant", PLANTS)
def test_presets_of_a_neural_closure_and_of_predictive_control(plant):
    made, usual = load_recipe(RECIPES / f"{plant}.py"), of_command_line(plant)
    neural, mpc = (of_command_line(plant, "--preset", preset) for preset in ("neural", "mpc"))
    assert neural.closure == "mlp" and neural.twinning.assimilation == made.NEURAL.assimilation
    assert dataclasses.replace(neural, preset="default") == of_command_line(plant, "--closure", "mlp")
    assert mpc.twinning.planner == dataclasses.replace(usual.twinning.planner, method="receding_horizon")
    assert dataclasses.replace(mpc, preset="default", twinning=usual.twinning) == usual
    both = of_command_line(plant, "--preset", "mpc", "--closure", "mlp")
    assert both.twinning.assimilation == neural.twinning.assimilation
    assert both.twinning.planner.method == "receding_horizon"


@pytest.mark.parametrize("plant", [*PLANTS, "pendulum", "served_turbine"])
def test_the_help_has_a_screenful_of_options_and_help_all_has_the_rest(plant, capsys):
    config = config_class_of(RECIPES / f"{plant}.py")
    listed = []
    for word in ("--help", "--help-all"):
        with pytest.raises(SystemExit, match="0"):
            from_command_line(config, ["--episodes", "0", word])  # beside what cannot be carried out, too
        listed.append(re.findall(r"(?m)^[│ ]*--([a-z][a-z.-]*)", capsys.readouterr().out))
    short, full = (set(names) - {"help-all"} for names in listed)
    parts = {field.name for field in dataclasses.fields(config) if dataclasses.is_dataclass(field.type)}
    assert {name.replace("-", "_") for name in short} == {field.name for field in dataclasses.fields(config)} - parts
    assert short < full and {"twinning.learner.discount", "operation.speed"} < full


def test_an_option_that_a_recipe_declares_anew_keeps_what_its_base_allows():
    @configuration
    class Fewer(RunConfig):
        episodes: int = 6
        noise: float = 0.5
        hidden: tuple[int, ...] = (4,)

    assert Fewer().episodes == 6 and RunConfig().episodes == 20
    for options in ({"episodes": 0}, {"noise": -2.0}, {"hidden": (8, 0)}, {"episodes": 2.5}, {"twinning": None}):
        for read in (lambda given: Fewer(**given), lambda given: read_options(Fewer, given)):
            with pytest.raises(ValueError, match="must be"):
                read(options)


def test_an_option_of_a_recipe_that_hides_a_group_of_options_is_named():
    @configuration
    class Logged(RunConfig):
        log: str = "log.csv"

    with pytest.raises(ValueError, match="log of Logged hides an option of RunConfig; give it another name"):
        Logged()


# What a recipe's command line tells in one line instead of a traceback.


@configuration
class Config(RunConfig):
    """Configuration of a recipe."""


@pytest.fixture(autouse=True)
def _no_words(monkeypatch):
    """A recipe is called without options."""
    monkeypatch.setattr(sys, "argv", ["recipe.py"])


def without_a_package(config):
    try:
        import not_installed  # noqa: F401
    except ImportError as error:
        raise RuntimeError("as Gymnasium says it") from error


def pressed(config):
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("main", "kind", "message"),
    [
        (lambda config: importlib.import_module("not_installed.part"), SystemExit, "error: the package not_installed"),
        (without_a_package, SystemExit, "error: the package not_installed is not installed; .* --extra EXTRA"),
        (lambda config: Path("gone.bts").read_text(), SystemExit, "error: .*No such file or directory: 'gone.bts'"),
        (lambda config: dataclasses.replace(config, seed=-1), SystemExit, "error: seed=-1 must be"),
        (pressed, SystemExit, "130"),
        (lambda config: torch.ones(2).view(3, 3), RuntimeError, "."),
        (lambda config: rk4_step(None, None, None), TypeError, "."),
        (lambda config: Plant.vector_field(None, None, None, None, None, None), NotImplementedError, "^$"),
    ],
)
def test_what_the_user_can_mend_is_told_in_a_line_and_another_error_keeps_its_traceback(main, kind, message):
    with pytest.raises(kind, match=message):
        main_of(Config, main)
