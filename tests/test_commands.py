"""The commands that README and documentation print can be given as they are printed."""

import contextlib
import io
import re
import shlex
from functools import cache

import pytest
from printed_commands import ROOT, commands, options

from rt_torchrl.runs.command_line import from_command_line
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.settings import module_of

RECIPES = sorted(path.stem for path in (ROOT / "recipes").glob("*.py"))
CONFIGS = {name: module_of(ROOT / "recipes" / f"{name}.py").Config for name in RECIPES}
OF_A_RECIPE = [command for command in commands() if "recipes/" in command]


def whole(name, arguments):
    """The arguments with those that the recipe does nothing without."""
    if name == "export":
        return ["run", *arguments]
    if name not in ("identify", "record_log"):
        return arguments
    system = [] if {"--plant", "--recipe"} & set(arguments) else ["--plant", "wind_turbine"]
    return ["log.csv", *system, *arguments]


def refusal(name, arguments):
    """What the command line of a recipe says against these arguments, or None."""
    if "--config" in arguments:  # of a run that is not there
        place = arguments.index("--config") + 1
        arguments = [*arguments[:place], str(ROOT / "tests" / "no_options.json"), *arguments[place + 1 :]]
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
    recipes = ("wind_turbine", *RECIPES)  # most sentences are about the turbine
    having = [name for name in recipes if all(re.search(rf"{flag}\b", help_of(name)) for flag in flags)]
    assert having, given
    if len(arguments) > 1:
        assert any(refusal(name, whole(name, arguments)) is None for name in having)


@cache
def help_of(name):
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), pytest.raises(SystemExit):
        from_command_line(CONFIGS[name], ["--help-all"])
    return shown.getvalue()


def test_an_option_that_does_not_exist_is_found():
    """Otherwise the tests above would show nothing."""
    assert "--planer" in refusal("wind_turbine", ["--planer", "1"]) and refusal("wind_turbine", ["--policy", "cubic"])


PACKAGES = {"lint-imports": "import-linter", "sphinx-build": "sphinx"}
"""The packages of programs that ``uv run`` starts, where they have another name."""
FILES = [".ci/run", ".ci/nightly", ".pre-commit-config.yaml", "pyproject.toml", "tests/test_fault_campaign.py"]


def test_a_command_asks_for_the_groups_that_have_its_program():
    """A clone in which nothing was installed before has no other packages."""
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 reads no TOML")
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in FILES]
    for command in {*commands(), *(found for text in texts for found in re.findall(r"uv run [^`\n]+", text))}:
        words, needed = shlex.split(command)[2:], [*declared["project"]["dependencies"]]
        while words[0] in ("--group", "--extra", "--with"):
            if words[0] == "--group":
                needed += declared["dependency-groups"][words[1]]
            words = words[2:]
        package = PACKAGES.get(words[0], words[0])
        assert package.endswith(".py") or any(re.match(rf"{package}\b(?!-)", text) for text in needed), command
