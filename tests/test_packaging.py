"""What a user installs: folders, wheel and command, public names, and what a start has to wait for."""

import ast
import importlib
import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import rt_torchrl
from rt_torchrl.runs import console

ROOT = Path(__file__).parent.parent
RECIPES = {path.stem for path in (ROOT / "recipes").glob("*.py")}
MISSING = [name for name in ("build", "hatchling") if importlib.util.find_spec(name) is None]


def test_no_file_imports_the_folder_by_its_own_name():
    """``import envs.x`` would make a second class of every plant."""
    for path in [p for folder in ("rt_torchrl", "envs", "tests", "recipes") for p in (ROOT / folder).rglob("*.py")]:
        lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
        assert not [line for line in lines if line.startswith(("import envs", "from envs"))], path


def installed_with(requirements, declared):
    """Names of the packages that come with requirements, by what the packages that are installed here say they need.

    Args:
        requirements: texts of requirements.
        declared: ``project`` of ``pyproject.toml``, which stands for the library itself.
    """
    found, open_ = set(), [(Requirement(text), "") for text in requirements]
    while open_:
        needed, extra = open_.pop()
        if needed.marker and not needed.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(needed.name)
        for asked in {"", *needed.extras}:
            if (name, asked) in found:
                continue
            found.add((name, asked))
            if name == "rt-torchrl":
                texts = declared["optional-dependencies"].get(asked, []) if asked else declared["dependencies"]
            else:
                texts = importlib.metadata.requires(name) or []
            open_ += [(Requirement(text), asked) for text in texts]
    return {name for name, _ in found}


def project():
    """``project`` of ``pyproject.toml``."""
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 reads no TOML")
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert declared["tool"]["uv"]["default-groups"] == []
    return declared["project"]


def test_the_first_command_installs_few_packages():
    """What tests, style, types and documentation need comes only to those who ask for it."""
    found = installed_with(["rt_torchrl"], project())
    assert {"torch", "torchrl", "tensorboard", "tyro"} <= found and len(found) <= 80, sorted(found)
    assert not {"pytest", "mypy", "basedpyright", "sphinx", "jax", "pandas", "onnxruntime", "coolprop"} & found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built into a temporary folder; nothing is left in the checkout."""
    if MISSING:
        pytest.skip(f"building a wheel needs {' and '.join(MISSING)}, which are not installed")
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (found,) = out.glob("*.whl")
    return found


def test_the_wheel_maps_the_folder_and_holds_data_recipes_and_command(wheel):
    archive = zipfile.ZipFile(wheel)
    names = set(archive.namelist())
    data = {f"rt_torchrl/{p.relative_to(ROOT).as_posix()}" for p in (ROOT / "envs").glob("*/data/*") if p.is_file()}
    code = {p.relative_to(ROOT).as_posix() for p in (ROOT / "rt_torchrl").rglob("*.py")} - {"rt_torchrl/envs.py"}
    assert data | code <= names
    # What type checkers read, and what ``rt_torchrl/__init__.py`` reads its public names from.
    assert {"rt_torchrl/py.typed", "rt_torchrl/__init__.pyi"} <= names
    assert "rt_torchrl/envs/wind_turbine/plant.py" in names
    tops = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    # No distribution-wide ``envs``, ``tests`` or ``recipes``, and no shim that would shadow the folder.
    assert tops == {"rt_torchrl"} and "rt_torchrl/envs.py" not in names
    assert {Path(name).stem for name in names if re.fullmatch(r"rt_torchrl/recipes/[^/]*", name)} == RECIPES
    assert wheel.name.startswith(f"rt_torchrl-{rt_torchrl.__version__}-")
    about = f"rt_torchrl-{rt_torchrl.__version__}.dist-info/"
    metadata, commands = (archive.read(about + name).decode() for name in ("METADATA", "entry_points.txt"))
    assert f"\nVersion: {rt_torchrl.__version__}\n" in metadata and "\nClassifier: Typing :: Typed\n" in metadata
    assert "rt-torchrl = rt_torchrl.runs.console:main" in commands


# People import what they use from ``rt_torchrl`` itself, and wait for nothing that they do not use.


STUB = ast.parse((ROOT / "rt_torchrl" / "__init__.pyi").read_text(encoding="utf-8"))
HOMES = {
    alias.name: f"rt_torchrl.{node.module}"
    for node in STUB.body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
"""The module that each public name comes from."""


@pytest.mark.parametrize("name", sorted(HOMES))
def test_every_name_is_what_its_module_defines(name):
    assert getattr(rt_torchrl, name) is getattr(importlib.import_module(HOMES[name]), name)


def test_type_checkers_and_people_see_the_same_names():
    (listed,) = (ast.literal_eval(n.value) for n in STUB.body if isinstance(n, ast.Assign))
    assert sorted(listed) == sorted(HOMES) == sorted(rt_torchrl.__all__) == sorted(dir(rt_torchrl))


READ = {"paper", "paper_figures"}
"""Recipes whose parts stand at the top, because they are read as much as run."""
LATE = [str(path) for path in sorted((ROOT / "recipes").glob("*.py")) if path.stem not in READ]
"""The others, which load what a command does not need only after its options."""


def test_the_help_of_a_recipe_waits_for_pytorch_alone():
    code = (
        "import contextlib, pathlib, runpy, sys\n"
        "for path in sys.argv[1:]:\n"
        "    sys.argv, sys.path[0] = [path, '--help'], str(pathlib.Path(path).parent)\n"
        "    with contextlib.suppress(SystemExit):\n"
        "        runpy.run_path(path, run_name='__main__')\n"
        "late = ('matplotlib', 'scipy', 'sklearn', 'pandas', 'torch._dynamo', 'torch._inductor', 'tensordict',\n"
        "        'torchrl', 'torchdiffeq', 'onnx', 'jax')\n"
        "print([name for name in late if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, *LATE], cwd=ROOT, capture_output=True, text=True)
    helped = [line for line in done.stdout.splitlines() if line.startswith("usage: ")]
    assert (len(helped), done.stdout.splitlines()[-1]) == (len(LATE), "[]"), done.stdout + done.stderr


# The command rt-torchrl: what it lists, what it runs, and the wheel that gives it.


def test_it_lists_every_recipe_and_refuses_an_unknown_one_with_the_nearest(capsys):
    console.main(["--help"])
    lines = capsys.readouterr().out.splitlines()
    assert {line.split()[0] for line in lines if re.match("  [^ ]", line)} == RECIPES | {"FILE.py"}
    for word, message in (("wind_turbin", "no recipe .*; did you mean wind_turbine"), ("mine.py", "no recipe")):
        with pytest.raises(SystemExit, match=message):
            console.main([word])
    assert console.recipe("wind-turbine") == ROOT / "recipes" / "wind_turbine.py"  # names may have hyphens


@pytest.mark.nightly
@pytest.mark.skipif(bool(MISSING), reason="building a wheel needs build and hatchling")
def test_an_installed_wheel_trains_and_is_read_back_without_further_packages(wheel, tmp_path):
    """In an environment that has the packages of a plain installation alone, from a folder outside the checkout."""
    home = tmp_path / "env"
    venv.create(home, with_pip=False)
    (site,) = home.glob("lib/python*/site-packages")
    zipfile.ZipFile(wheel).extractall(site)
    for name in installed_with(["rt_torchrl"], project()) - {"rt-torchrl"}:
        distribution = importlib.metadata.distribution(name)
        for top in {file.parts[0] for file in distribution.files} - {"..", "__pycache__"}:
            if not (site / top).exists():
                (site / top).symlink_to(distribution.locate_file(top))
    assert not list(site.glob("pytest*")) and not list(site.glob("[Cc]ool[Pp]rop*"))
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    program = "from rt_torchrl.runs.console import main; main()"

    def run(*words):
        command = [str(home / "bin" / "python"), "-c", program, *words]
        return subprocess.run(command, cwd=tmp_path, env=clean, capture_output=True, text=True)

    trained = run("wind_turbine", "--quick", "--threads", "1", "--no-figures", "--log-dir", "run")
    assert trained.returncode == 0 and "recipes/" not in trained.stdout, trained.stderr
    exported = run("export", "run", "--formats", "c")
    assert exported.returncode == 0 and list((tmp_path / "run" / "exported").glob("*.c")), exported.stderr
