"""Between a command and its first episode, a recipe loads nothing that this episode does not use."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FIRST_EPISODES = """
import runpy, sys
from rt_torchrl import atomic_file

write = atomic_file.write_atomically

class Done(BaseException):
    pass

def until_checkpoint(path, content):
    if path.name == "checkpoint.pt":  # which is written at the end of an episode
        raise Done
    write(path, content)

atomic_file.write_atomically = until_checkpoint
folder, *recipes = sys.argv[1:]
for path in recipes:
    sys.argv = [path, "--quick", "--figures-every", "2", "--threads", "1", "--log-dir", f"{folder}/{len(path)}"]
    if "flapping_wing" not in path:  # one learns from a controller, which takes longer than its first episode
        sys.argv += ["--start", "random"]
    try:
        runpy.run_path(path, run_name="__main__")
    except Done:
        late = ("matplotlib", "onnx", "jax", "casadi", "gymnasium", "torch._inductor.compile_fx", "torchrl.collectors")
        print("late:", [name for name in late if name in sys.modules], flush=True)
"""


@pytest.mark.slow
def test_the_first_episodes_load_only_what_they_use(tmp_path):
    recipes = [str(ROOT / "recipes" / f"{name}.py") for name in ("wind_turbine", "flapping_wing", "cryogenic_tank")]
    command = [sys.executable, "-c", FIRST_EPISODES, str(tmp_path), *recipes]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    said = [line for line in done.stdout.splitlines() if line.startswith("late: ")]
    assert said == ["late: []"] * 3, done.stdout + done.stderr


def test_every_recipe_says_that_it_starts_before_it_loads_pytorch():
    """The import of PyTorch fails here; it comes after the line, or the line would be missing."""
    code = (
        "import contextlib, runpy, sys\n"
        "sys.modules['torch'] = None\n"
        "for path in sys.argv[1:]:\n"
        "    sys.path.insert(0, 'recipes')\n"
        "    with contextlib.suppress(ImportError):\n"
        "        runpy.run_path(path, run_name='__main__')\n"
        "    print('ended', file=sys.stderr)"
    )
    recipes = [str(path) for path in sorted((ROOT / "recipes").glob("*.py"))]
    done = subprocess.run([sys.executable, "-c", code, *recipes], cwd=ROOT, capture_output=True, text=True)
    assert done.stderr.splitlines() == ["loading PyTorch and TorchRL", "ended"] * len(recipes), done.stderr


@pytest.mark.parametrize("given, expected", [({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")])
def test_threads_of_a_program_wait_without_a_core_unless_its_user_says_otherwise(given, expected):
    code = "import os; from rt_torchrl import begin_loading; begin_loading(); print(os.environ['OMP_WAIT_POLICY'])"
    without = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=without | given, capture_output=True, text=True)
    assert done.stdout.strip() == expected, done.stderr
