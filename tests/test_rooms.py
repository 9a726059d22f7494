"""The rooms stand above each other, as the settings and the contributing page say; type checkers find all."""

import ast
import graphlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
LINT = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"


def layers():
    """The rooms by floor, the uppermost first, as ``pyproject.toml`` states them."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (found,) = re.findall(r'containers = \["rt_torchrl"\]\nlayers = \[(.*?)\]', text, re.DOTALL)
    return [floor.split(" | ") for floor in ast.literal_eval(f"[{found}]")]


def test_no_room_imports_one_above_it():
    pytest.importorskip("importlinter", reason="the order of the rooms is read by import-linter")
    done = subprocess.run([sys.executable, "-c", LINT], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_module_of_the_library_imports_from_its_top():
    """The public names of ``rt_torchrl`` come from every floor; an import of one would hide its floor."""
    rooms = {room for floor in layers() for room in floor} | {"envs"}
    for path in [p for folder in ("rt_torchrl", "envs") for p in (ROOT / folder).rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module == "rt_torchrl":
                assert {alias.name for alias in node.names} <= rooms, path


@pytest.mark.parametrize("plant", ["cascaded_tanks", "cryogenic_tank", "flapping_wing", "pendulum"])
def test_the_parts_of_a_plant_import_each_other_in_one_order(plant):
    """Also where an import stands in a function; import-linter takes ``rt_torchrl.envs`` for one module."""
    imported, place = {}, f"rt_torchrl.envs.{plant}"
    for path in (ROOT / "envs" / plant).glob("*.py"):
        parts = imported.setdefault(path.stem, set())
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module == place:
                parts |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{place}."):
                parts.add(node.module.removeprefix(f"{place}."))
    order = list(graphlib.TopologicalSorter(imported).static_order())  # raises if there is none
    assert {"plant", "__init__"} <= set(order)


def test_contributors_read_the_same_order():
    text = (ROOT / "docs" / "contributing.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| `(?:rt_torchrl/)?(\w+)/` \|", text, re.MULTILINE)
    rooms = [name for floor in layers() for name in floor if (ROOT / "rt_torchrl" / name).is_dir()]
    assert table == rooms
    assert all(f"`rt_torchrl/{name}.py`" in text for name in layers()[-1])  # single modules, below all rooms


# Type checkers and editors find ``rt_torchrl.envs`` and the public names in a checkout.


LINK = ROOT / ".typings" / "rt_torchrl" / "envs"


def test_the_link_is_the_folder_beside_the_package():
    if not LINK.is_dir():
        pytest.skip("this checkout has no symbolic links; docs/contributing.md says how to get them")
    assert LINK.resolve() == (ROOT / "envs").resolve()


def test_no_error_of_a_type_checker_is_silenced():
    for folder in ("rt_torchrl", "envs"):
        for path in (ROOT / folder).rglob("*.py*"):
            if path.suffix in (".py", ".pyi"):
                assert "type: ignore" not in path.read_text(encoding="utf-8"), path
