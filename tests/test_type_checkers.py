"""Type checkers and editors find ``rt_torchrl.envs`` and the public names in a checkout."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
LINK = ROOT / ".typings" / "rt_torchrl" / "envs"
COMMANDS = {
    # Nothing that is imported is checked, only found: seconds instead of a minute.
    "mypy": ["mypy", "--follow-imports", "skip", "--cache-dir", os.devnull],
    "basedpyright": ["basedpyright", "--pythonpath", sys.executable, "--level", "error"],
}


@pytest.fixture
def probe():
    """A file in the checkout, where an editor would read it; it is removed again."""
    path = ROOT / "probe_of_type_checkers.py"
    yield path
    path.unlink(missing_ok=True)


def checked(checker, probe, code):
    """Exit status and output of a type checker on a file of this code."""
    if importlib.util.find_spec(checker) is None:
        pytest.skip(f"{checker} is not installed")
    if not LINK.is_dir():
        pytest.skip("this checkout has no symbolic links; docs/contributing.md says how to get them")
    probe.write_text(code, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", *COMMANDS[checker], str(probe)], cwd=ROOT, capture_output=True, text=True
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize("checker", COMMANDS)
def test_every_module_of_the_plants_is_found(checker, probe):
    """And a module that does not exist is the one error, without which the rest would show nothing."""
    modules = sorted(".".join(path.relative_to(ROOT).with_suffix("").parts) for path in (ROOT / "envs").glob("*/*.py"))
    code = "".join(f"import rt_torchrl.{name.removesuffix('.__init__')}\n" for name in modules)
    code += "from rt_torchrl import Plant, Run, check_plant\nimport rt_torchrl.envs.wind_turbine.plnt\n"
    status, output = checked(checker, probe, code)
    assert status == 1 and len(modules) > 30 and "rt_torchrl.envs.wind_turbine.plnt" in output, output
    assert len(re.findall(r"error: ", output)) == 1, output


def test_the_link_is_the_folder_beside_the_package():
    if not LINK.is_dir():
        pytest.skip("this checkout has no symbolic links; docs/contributing.md says how to get them")
    assert LINK.resolve() == (ROOT / "envs").resolve()


def test_no_error_of_a_type_checker_is_silenced():
    for folder in ("rt_torchrl", "envs"):
        for path in (ROOT / folder).rglob("*.py*"):
            if path.suffix in (".py", ".pyi"):
                assert "type: ignore" not in path.read_text(encoding="utf-8"), path
