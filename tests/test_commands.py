"""The commands that README and documentation print can be given as they are printed."""

import contextlib
import io
import re
import shlex
from functools import cache
from pathlib import Path

import pytest
from printed_commands import ROOT, TEXTS, commands, options

from rt_torchrl.runs.command_line import from_command_line
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.settings import module_of

RECIPES = sorted(path.stem for path in (ROOT / "recipes").glob("*.py"))
CONFIGS = {name: module_of(ROOT / "recipes" / f"{name}.py").Config for name in RECIPES}
OF_A_RECIPE = [command for command in commands() if "recipes/" in command]
PYTEST, MYPY = "uv run --group test pytest", "uv run --group test --group lint mypy"
BUILD = "uv run --group docs sphinx-build -W --keep-going docs docs/_build"


def whole(name, arguments):
    """The arguments with those that the recipe does nothing without."""
    if name == "export":
        return ["run", *arguments]
    if name not in ("identify", "record_log"):
        return arguments
    system = [] if {"--plant", "--recipe"} & set(arguments) else ["--plant", "wind_turbine"]
    return ["log.csv", *system, *arguments]


NO_OPTIONS = ROOT / "tests" / "no_options.json"
"""A file of options that gives none, in the place of one that a run leaves."""


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


@pytest.mark.parametrize("given", [given for given in options() if given != "--help-all"])  # another help
def test_a_recipe_takes_the_options_that_a_sentence_names(given):
    """Some recipe does; an option that is named without its value stands in its help."""
    arguments = shlex.split(given)
    flags = [word for word in arguments if word.startswith("--")]
    # Most sentences are about the turbine.
    having = [
        name for name in ("wind_turbine", *RECIPES) if all(re.search(rf"{flag}\b", help_of(name)) for flag in flags)
    ]
    assert having, given
    refusals = []
    for name in having if len(arguments) > 1 else ():
        refusals.append(refusal(name, whole(name, arguments)))
        if refusals[-1] is None:
            return
    assert not refusals, refusals


@cache
def help_of(name):
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), pytest.raises(SystemExit):
        from_command_line(CONFIGS[name], ["--help-all"])
    return shown.getvalue()


def test_checks_that_are_printed_are_what_ci_runs():
    """The tests do not run themselves, nor the type checker over everything."""
    script = [line.removesuffix(" &") for line in (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()]
    assert {MYPY, BUILD} <= set(script)
    assert any(line.startswith(f"{PYTEST} -n 2 --dist loadfile") for line in script)
    assert Path(ROOT / ".pre-commit-config.yaml").exists() and len(TEXTS) >= 5
