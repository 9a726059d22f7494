"""The commands that README and documentation print can be given as they are printed."""

import contextlib
import io
import re
import shlex
from functools import cache
from pathlib import Path

import pytest
from printed_commands import ROOT, TEXTS, commands, options, spans

from rt_torchrl.runs.command_line import from_command_line
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.user_code import module_of

RECIPES = sorted(path.stem for path in (ROOT / "recipes").glob("*.py"))
CONFIGS = {name: module_of(ROOT / "recipes" / f"{name}.py").Config for name in RECIPES}
OF_A_RECIPE = [command for command in commands() if "recipes/" in command]
BUILD = "uv run --extra docs sphinx-build -W --keep-going docs docs/_build"


def whole(name, arguments):
    """The arguments with those that the recipe does nothing without."""
    if name == "unknown":
        return ["flapping_wing", *arguments]
    if name in ("compare", "export", "in_service", "real_time", "report"):
        return ["run", *arguments]
    if name not in ("identify", "record_log"):
        return arguments
    system = [] if {"--plant", "--recipe"} & set(arguments) else ["--plant", "wind_turbine"]
    return ["log.csv", *system, *arguments]


NO_OPTIONS = ROOT / "tests" / "no_options.json"
"""A file of options that gives none, in the place of one that a run leaves."""


@pytest.fixture(autouse=True)
def _with_every_logger(monkeypatch):
    """As if the packages that the documentation tells to install were there."""
    monkeypatch.setattr("rt_torchrl.runs.loggers.PACKAGES", {})


def refusal(name, arguments):
    """What the command line of a recipe says against these arguments, or None."""
    if "--config" in arguments:
        place = arguments.index("--config") + 1
        arguments = [*arguments[:place], str(NO_OPTIONS), *arguments[place + 1 :]]
    if issubclass(CONFIGS[name], RunConfig):
        arguments = [*arguments, "--log-dir", "somewhere"]  # what --resume needs, and --help does not mind
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            from_command_line(CONFIGS[name], arguments)
    except SystemExit as left:
        return said.getvalue() if left.code else None
    except ValueError as error:
        return str(error)
    return None


@pytest.mark.parametrize("command", OF_A_RECIPE)
def test_a_recipe_takes_its_printed_options(command):
    before, path, arguments = re.fullmatch(r"uv run (.*?)recipes/(\w+)\.py ?(.*)", command).groups()
    declared = (ROOT / "pyproject.toml").read_text(encoding="utf-8").split("[project.optional-dependencies]")[1]
    assert all(f"\n{extra} = [" in declared for extra in re.findall(r"--extra (\w+)", before))
    # The engine that somebody has just added.
    assert refusal(path, shlex.split(arguments.replace("NAME", "autograd"))) is None


@pytest.mark.parametrize("given", options())
def test_a_recipe_takes_the_options_that_a_sentence_names(given):
    """Some recipe does; an option that is named without its value stands in its help."""
    arguments, said = shlex.split(given), []
    for name in ("wind_turbine", *RECIPES):  # most sentences are about it
        said.append(refusal(name, whole(name, arguments)))
        if said[-1] is None:
            return
    assert len(arguments) == 1, said
    assert any(re.search(rf"{given}\b", help_of(name)) for name in RECIPES), given


@cache
def help_of(name):
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), pytest.raises(SystemExit):
        from_command_line(CONFIGS[name], ["--help"])
    return shown.getvalue()


def test_an_option_that_does_not_exist_is_found():
    """Otherwise the tests above would show nothing."""
    assert "--planer" in refusal("wind_turbine", ["--planer", "1"])
    assert refusal("wind_turbine", ["--policy", "cubic"]) and refusal(
        "identify", whole("identify", ["--initial", "guessed"])
    )


def test_every_choice_of_a_policy_is_taken():
    """The page of the options lists them behind the first one: bias, scheduled or mlp."""
    assert {"bias", "scheduled", "mlp"} <= set(spans("options.md"))
    for name in ("bias", "scheduled", "mlp"):
        assert refusal("wind_turbine", ["--policy", name]) is None


def test_checks_that_are_printed_are_what_ci_runs():
    """The tests do not run themselves, nor the type checker over everything."""
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    assert {"uv run mypy", BUILD} <= set(script)
    assert any(line.startswith("uv run pytest -n 2 --dist loadfile") for line in script)
    rest = [command for command in commands() if command not in OF_A_RECIPE]
    known = {"uv run mypy", "uv run pytest -n 2 --dist loadfile", "uv run pytest -m slow", "uv run pytest -m nightly"}
    known |= {'uv run pytest tests/test_neural_residual.py -n 0 -s -m "slow or nightly"'}  # they are run as tests
    known |= {"uv run quadrotor.py", "uv run heated_room.py"}  # tests/test_own_plants.py
    known |= {"uv run pytest -m faults", "uv run --extra fuzz tests/fuzz.py wind.bts -max_total_time=60"}
    assert set(rest) - known == {"uv run pre-commit install", "uv run tensorboard --logdir runs", BUILD}
    assert Path(ROOT / ".pre-commit-config.yaml").exists() and len(TEXTS) >= 5


def test_one_word_for_the_folder_of_the_results():
    """Recipes that print, or read a run and write beside it or nowhere, have none."""
    without = {"benchmark", "compare", "coverage", "export", "record_log", "report"}
    for name in set(RECIPES) - without:
        assert "--log-dir" in help_of(name), name
