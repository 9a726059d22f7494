"""The commands that README and documentation print, run as they are printed in a copy of the repository."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys

import pytest
from printed_commands import ROOT, commands

from rt_torchrl.runs.command_line import from_command_line
from rt_torchrl.runs.settings import module_of

pytestmark = pytest.mark.slow
TRAININGS = [
    command
    for command in commands()
    if re.search(r"recipes/(wind_turbine|pendulum)\.py", command) and "--help" not in command
]
LAST = "uv run recipes/wind_turbine.py --episodes 1 --unseen 2 --quick --horizon 20 --log-dir "
PATIENCE = 300.0  # [s] for what takes seconds on a quiet machine


def require_quiet(done):
    """Nothing is in the log but what the run itself says: on the error stream that it loads, and how far it is."""
    first, *lines = [line for line in done.stderr.replace("\r", "\n").splitlines() if line.strip()]
    assert first == "loading PyTorch and TorchRL"
    assert lines and all(re.fullmatch(r"episode \d+/\d+: .*|[a-z -]+", line) for line in lines), done.stderr[:3000]
    assert not re.search(r"torch\.jit|CUDA_HOME|\[torchrl\]|Warning", done.stdout), done.stdout


@pytest.fixture(scope="module")
def clone(tmp_path_factory):
    """What a fresh clone has, without the history."""
    folder = tmp_path_factory.mktemp("clone")
    for name in ("README.md", "LICENSE", "pyproject.toml", ".pre-commit-config.yaml"):
        shutil.copy(ROOT / name, folder / name)
    for name in ("rt_torchrl", "envs", "recipes"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "docs").mkdir()
    for page in (ROOT / "docs").glob("*.md"):  # some commands write their findings into a page
        shutil.copy(page, folder / "docs" / page.name)
    return folder


def done(command, clone):
    """The command as printed, in a shell; uv takes the environment of this process instead of making one."""
    if shutil.which("uv") is None:
        pytest.skip("the printed commands are run by uv")
    # The folder comes before what that environment has installed.
    own = {"UV_NO_SYNC": "1", "UV_PROJECT_ENVIRONMENT": sys.prefix, "PYTHONPATH": str(clone)}
    options = {"cwd": clone, "env": os.environ | own, "timeout": PATIENCE}
    ended = subprocess.run(["bash", "-c", f"exec {command}"], capture_output=True, text=True, **options)
    assert ended.returncode == 0, f"{command}\n{ended.stdout[-2000:]}\n{ended.stderr[-3000:]}"
    return ended


class BegunError(Exception):
    """What a command was asked for has begun."""


def begun(*_, **__):
    raise BegunError


def require_begun_here(command, clone, monkeypatch, begin):
    """The main of the printed recipe on the printed options, up to what ``begin`` names."""
    name, arguments = re.fullmatch(r"uv run .*?recipes/(\w+)\.py ?(.*)", command).groups()
    module = module_of(clone / "recipes" / f"{name}.py")
    monkeypatch.chdir(clone)
    monkeypatch.setattr(begin if "." in begin else f"{module.__name__}.{begin}", begun)
    with pytest.raises(BegunError):
        module.main(from_command_line(module.Config, shlex.split(arguments)))


@pytest.mark.parametrize("command", TRAININGS)
def test_a_printed_training_begins(command, clone, monkeypatch):
    """Up to its first real episode; the tests of the algorithm train on."""
    assert TRAININGS[0] == "uv run recipes/wind_turbine.py --quick"
    if "rosco" in command:
        pytest.importorskip("rosco")
    first = "rt_torchrl.algorithm.ReinforcementTwinning.episode"
    folder = re.search(r"(runs/wind_turbine/TIME-seed-0)/config\.json", command)
    if folder:  # the options of a run that is there
        earlier = f"uv run recipes/wind_turbine.py --quick --log-dir {folder[1]}"
        require_begun_here(earlier, clone, monkeypatch, first)
    require_begun_here(command, clone, monkeypatch, first)


def test_a_quick_training_of_the_pendulum_compiles_and_is_quiet(clone):
    """From its first second on nothing of PyTorch or TorchRL stands on the terminal."""
    assert "uv run --extra gym recipes/pendulum.py --seed 0" in commands()
    shown = done("uv run --extra gym recipes/pendulum.py --seed 0 --quick", clone)
    require_quiet(shown)
    (folder,) = re.findall(r"results in (\S+)", shown.stdout)
    found = json.loads((clone / folder / "metrics.json").read_text(encoding="utf-8"))["summary"]["closure"]["found"]
    assert found == pytest.approx({"mass": 1.0, "length": 1.0}, rel=1e-4)  # by Gymnasium's single precision


def test_a_log_is_recorded_and_identified(clone):
    record, identify = (next(c for c in commands() if name in c) for name in ("record_log", "identify"))
    assert "log.csv" in record and '"rpm=rotor_speed[rpm]"' in identify
    done(record, clone)
    header, rest = (clone / "log.csv").read_text(encoding="utf-8").split("\n", 1)
    assert "rotor_speed" in header
    # The log of the documentation has a sensor of another name and unit.
    speed = header.split(",").index("rotor_speed")
    rows = [line.split(",") for line in rest.splitlines()]
    for row in rows:
        row[speed] = str(float(row[speed]) * 9.549296585513721) if row[speed] else ""
    lines = [header.replace("rotor_speed", "rpm"), *(",".join(row) for row in rows)]
    (clone / "log.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert "rotor_speed" in done(identify, clone).stdout


@pytest.mark.parametrize(("formats", "kinds"), [("c onnx", {".c", ".h", ".onnx"}), ("discon", {".c", ".so"})])
def test_a_policy_is_exported(formats, kinds, clone):
    (command,) = (c for c in commands() if "recipes/export.py" in c and c.endswith(f"--formats {formats}"))
    folder = re.search(r"runs/\S+", command).group()
    shutil.rmtree(clone / folder, ignore_errors=True)  # a command before may have begun a run there
    done(f"{LAST}{folder}", clone)
    done(command, clone)
    assert kinds <= {path.suffix for path in (clone / folder / "exported").iterdir()}


@pytest.mark.parametrize("command", [command for command in commands() if "recipes/study.py" in command])
def test_a_printed_study_begins(command, clone, monkeypatch):
    """Up to its plan of tasks; the tests of the study run some."""
    require_begun_here(command, clone, monkeypatch, "rt_torchrl.compare_runs" if "--runs" in command else "run_all")
