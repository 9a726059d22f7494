"""Between a command and its first episode, a recipe loads nothing that this episode does not use."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FIRST_EPISODE = """
import os, runpy, sys
from rt_torchrl import atomic_file

write = atomic_file.write_atomically

def until_checkpoint(path, content):
    if path.name != "checkpoint.pt":  # which is written at the end of an episode
        return write(path, content)
    late = ("matplotlib", "onnx", "jax", "casadi", "gymnasium", "torch._inductor.compile_fx",
            "torchrl.collectors")
    print("late:", [name for name in late if name in sys.modules], flush=True)
    os._exit(0)

atomic_file.write_atomically = until_checkpoint
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.parametrize(
    "recipe",
    [
        "wind_turbine",
        pytest.param("flapping_wing", marks=pytest.mark.slow),
        pytest.param("cryogenic_tank", marks=pytest.mark.slow),
    ],
)
def test_the_first_episode_loads_only_what_it_uses(recipe, tmp_path):
    code = f"import sys; sys.argv = sys.argv[1:]\n{FIRST_EPISODE}"
    options = ["--quick", "--figures-every", "2", "--threads", "1", "--log-dir", str(tmp_path / "run")]
    if recipe != "flapping_wing":  # one learns from a controller, which takes longer than its first episode
        options += ["--start", "random"]
    command = [sys.executable, "-c", code, str(ROOT / "recipes" / f"{recipe}.py"), *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1:] == ["late: []"], done.stdout + done.stderr


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
