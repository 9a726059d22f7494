"""The folder ``envs`` is ``rt_torchrl.envs``, in a checkout and in a built wheel."""

import importlib
import importlib.metadata
import importlib.util
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import rt_torchrl

ROOT = Path(__file__).parent.parent
MISSING = [name for name in ("build", "hatchling") if importlib.util.find_spec(name) is None]
PROBE = """
import rt_torchrl.envs.wind_turbine.plant as plant, rt_torchrl.envs as envs, sys
assert plant.WindTurbine.__module__ == "rt_torchrl.envs.wind_turbine.plant"
assert sys.modules["rt_torchrl.envs"] is envs and envs.wind_turbine is sys.modules["rt_torchrl.envs.wind_turbine"]
assert not [name for name in sys.modules if name == "envs" or name.startswith("envs.")]
plant.WindTurbine()
from rt_torchrl import Plant
assert issubclass(plant.WindTurbine, Plant)
print(plant.__file__)
"""


def test_checkout_imports_the_folder_under_one_name():
    """One module object, from the folder beside the package; nothing imports it as top-level ``envs``."""
    package = importlib.import_module("rt_torchrl.envs.wind_turbine")
    assert package is sys.modules["rt_torchrl.envs.wind_turbine"] is sys.modules["rt_torchrl.envs"].wind_turbine
    assert Path(package.__file__).resolve().parent == ROOT.resolve() / "envs" / "wind_turbine"
    assert not [name for name in sys.modules if name == "envs" or name.startswith("envs.")]


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


def test_the_first_command_installs_few_packages():
    """What tests, style, types and documentation need comes only to those who ask for it."""
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 reads no TOML")
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    groups = declared["tool"]["uv"].get("default-groups", ["dev"])
    of_groups = [text for group in groups for text in declared["dependency-groups"][group]]
    found = installed_with(["rt_torchrl", *of_groups], declared["project"])
    assert {"torch", "torchrl", "tensorboard", "tyro"} <= found and len(found) <= 80, sorted(found)
    assert not {"pytest", "mypy", "basedpyright", "playwright", "jax", "pandas", "onnxruntime"} & found


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


def test_wheel_maps_the_folder_and_holds_its_data(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    data = {f"rt_torchrl/{p.relative_to(ROOT).as_posix()}" for p in (ROOT / "envs").glob("*/data/*") if p.is_file()}
    code = {p.relative_to(ROOT).as_posix() for p in (ROOT / "rt_torchrl").rglob("*.py")} - {"rt_torchrl/envs.py"}
    assert data | code <= names
    # What type checkers read, and what ``rt_torchrl/__init__.py`` reads its public names from.
    assert {"rt_torchrl/py.typed", "rt_torchrl/__init__.pyi"} <= names
    assert {"rt_torchrl/envs/wind_turbine/plant.py", "rt_torchrl/envs/wind_turbine/data/NOTICE.md"} <= names
    tops = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    # No distribution-wide ``envs``, ``tests`` or ``recipes``, and no shim that would shadow the folder.
    assert tops == {"rt_torchrl"} and "rt_torchrl/envs.py" not in names


def test_wheel_has_the_version_that_the_package_states(wheel):
    assert wheel.name.startswith(f"rt_torchrl-{rt_torchrl.__version__}-")
    metadata = zipfile.ZipFile(wheel).read(f"rt_torchrl-{rt_torchrl.__version__}.dist-info/METADATA").decode()
    assert f"\nVersion: {rt_torchrl.__version__}\n" in metadata and "\nClassifier: Typing :: Typed\n" in metadata


@pytest.mark.slow
def test_wheel_works_without_the_checkout(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path)
    # The extracted wheel stands before a checkout that may be installed.
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n" + PROBE]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).is_relative_to(tmp_path.resolve())
