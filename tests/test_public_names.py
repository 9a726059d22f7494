"""People import what they use from ``rt_torchrl`` itself, and wait for nothing that they do not use."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rt_torchrl

ROOT = Path(__file__).resolve().parent.parent
STUB = ast.parse((ROOT / "rt_torchrl" / "__init__.pyi").read_text(encoding="utf-8"))
HOMES = {
    alias.name: f"rt_torchrl.{node.module}"
    for node in STUB.body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
"""The module that each public name comes from."""
ROOMS_OF = {
    "accuracy.py": {"evaluation", "runs", "study", "trajectories", "twinning"},
    "asynchronous.py": {"runs"},
    "benchmark.py": {"runs", "trajectories"},
    "cascaded_tanks.py": {"figures", "fit", "runs"},
    "compare.py": {"figures", "runs", "study"},
    "export.py": {"export", "runs"},
    "gallery.py": {"runs"},
    "identify.py": {"fit", "figures", "runs"},
    "in_service.py": {"runs", "systems"},
    "jitter.py": {"runs", "systems"},
    "limit.py": {"evaluation", "control", "runs", "study"},
    "memory.py": {"evaluation", "figures", "runs"},
    "pareto.py": {"runs", "study"},
    "partial.py": {"runs", "study"},
    "record_log.py": {"fit", "runs"},
    "soak.py": {"runs"},
    "study.py": {"study", "runs"},
    "sweep.py": {"figures", "runs", "study"},
    "unknown.py": {"study", "runs"},
    "worth.py": {"figures", "runs", "study"},
}
"""Recipes that are the command line of a room, and the rooms whose internal names they use."""


def sources():
    """The Python that people read first: every recipe, and every code block of the README and the tutorial."""
    for path in sorted((ROOT / "recipes").glob("*.py")):
        yield path.name, path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", ROOT / "docs" / "own_plant.md"):
        blocks = re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)
        assert blocks, path
        yield path.name, "\n".join(blocks)


def imports_of_rooms(code):
    """Pairs of a module of the library, not a plant's, and a name that is imported from it."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            found = [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found = [(node.module or "", alias.name) for alias in node.names]
        else:
            continue
        for module, name in found:
            parts = module.split(".")
            if parts[0] == "rt_torchrl" and parts[1:2] not in ([], ["envs"]):
                yield module, name


@pytest.mark.parametrize(("file", "code"), [pytest.param(*source, id=source[0]) for source in sources()])
def test_public_names_come_from_the_top(file, code):
    for module, name in imports_of_rooms(code):
        assert name not in HOMES, f"{file}: import {name} from rt_torchrl, not from {module}"
        assert module.split(".")[1] in ROOMS_OF.get(file, ()), f"{file} imports {name} from {module}"


@pytest.mark.parametrize("name", sorted(HOMES))
def test_every_name_is_what_its_module_defines(name):
    assert getattr(rt_torchrl, name) is getattr(importlib.import_module(HOMES[name]), name)


def test_type_checkers_and_people_see_the_same_names():
    (listed,) = (ast.literal_eval(n.value) for n in STUB.body if isinstance(n, ast.Assign))
    assert sorted(listed) == sorted(HOMES) == sorted(rt_torchrl.__all__) == sorted(dir(rt_torchrl))


def test_a_name_that_does_not_exist_is_refused():
    with pytest.raises(AttributeError, match="Plnt"):
        rt_torchrl.Plnt  # noqa: B018


def test_the_import_waits_for_nothing():
    """A user who asks for a version, or misspells a command, needs neither PyTorch nor TorchRL."""
    code = (
        "import sys, rt_torchrl; rt_torchrl.__version__, dir(rt_torchrl)\n"
        "print([name for name in ('torch', 'torchrl', 'sklearn', 'scipy', 'matplotlib') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


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
    recipes = [str(path) for path in sorted((ROOT / "recipes").glob("*.py"))]
    done = subprocess.run([sys.executable, "-c", code, *recipes], cwd=ROOT, capture_output=True, text=True)
    helped = [line for line in done.stdout.splitlines() if line.startswith("usage: ")]
    assert (len(helped), done.stdout.splitlines()[-1]) == (len(recipes), "[]"), done.stdout + done.stderr
