"""A run folder: who may write in it, what is overwritten, and with which options a run is resumed."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.run_folder import RunFolder
from rt_torchrl.runs.run_settings import require_same
from rt_torchrl.runs.settings import BESIDE, config_of, read_settings

HOLDER = """
import sys
import filelock
lock = filelock.FileLock(sys.argv[1])
lock.acquire()
print("held", flush=True)
sys.stdin.read()
"""


def begun(path, **options):
    """A run that has written its options."""
    config = RunConfig(log_dir=path, **options)
    folder = RunFolder(config, "p")
    folder.begin(config.effective())
    folder.release()
    return config


def contents(path):
    return {file.relative_to(path): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_a_folder_in_use_is_refused_until_it_is_let_go(tmp_path):
    folder = RunFolder(RunConfig(log_dir=tmp_path), "p")
    with pytest.raises(ValueError, match="log_dir=.* is in use by another training"):
        RunFolder(RunConfig(log_dir=tmp_path, overwrite=True), "p")
    folder.release()
    RunFolder(RunConfig(log_dir=tmp_path), "p").release()


def test_a_killed_process_lets_its_folder_go(tmp_path):
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path / ".lock")], stdin=-1, stdout=-1, text=True)
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(ValueError, match="is in use by another training"):
        RunFolder(RunConfig(log_dir=tmp_path), "p")
    holder.kill()
    holder.wait()
    RunFolder(RunConfig(log_dir=tmp_path), "p").release()


def test_what_killed_writers_left_is_removed(tmp_path):
    (tmp_path / ".checkpoint.pt.1-ab.partial").touch()
    RunFolder(RunConfig(log_dir=tmp_path), "p").release()
    assert not list(tmp_path.glob(".*.partial"))


def test_resume_and_overwrite_exclude_each_other(tmp_path):
    begun(tmp_path)
    (tmp_path / "checkpoint.pt").write_text("episodes")
    before = contents(tmp_path)
    with pytest.raises(ValueError, match="resume and overwrite exclude each other"):
        RunFolder(RunConfig(log_dir=tmp_path, resume=True, overwrite=True), "p")
    assert contents(tmp_path) == before


def changed_twinning():
    default = RunConfig().twinning
    rates = dataclasses.replace(default.learner, critic_rate=2e-3, discount=0.5)
    return dataclasses.replace(default, learner=rates)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"seed": 1}, "seed is 1 here and was 0 in the run"),
        ({"engine": "autograd"}, "engine is autograd here and was native in the run"),
        ({"quick": True}, "quick is True here and was False in the run"),
        ({"hidden": (4,)}, r"hidden is \[4\] here and was \[32, 32\] in the run"),
        ({"twinning": changed_twinning()}, "critic_rate is 0.002 here and was 0.001.*learner.discount is 0.5"),
    ],
)
def test_a_run_is_not_resumed_with_other_options(tmp_path, options, named):
    begun(tmp_path)
    before = contents(tmp_path)
    with pytest.raises(ValueError, match=named):
        RunFolder(RunConfig(log_dir=tmp_path, resume=True, **options), "p")
    assert contents(tmp_path) == before


def test_a_run_is_resumed_with_harmless_options(tmp_path):
    begun(tmp_path)
    harmless = {"episodes": 7, "figures": False, "figures_every": 0, "untrained": 0, "threads": 1, "reference": True}
    harmless["limit_episodes"] = 3
    begun(tmp_path, resume=True, unseen=3, unseen_every=2, compiled=False, **harmless)
    assert json.loads((tmp_path / "config.json").read_text())["episodes"] == 7
    # From now on episodes are judged on three unseen ones; the next are not to be judged on others.
    with pytest.raises(ValueError, match="unseen is 4 here and was 3"):
        begun(tmp_path, resume=True, unseen=4)


def test_an_option_of_a_later_version_had_its_default(tmp_path):
    config = begun(tmp_path)
    settings = json.loads((tmp_path / "config.json").read_text())
    del settings["noise"]
    (tmp_path / "config.json").write_text(json.dumps(settings))
    require_same(tmp_path, config)
    with pytest.raises(ValueError, match="noise is 0.1 here and was 0.0"):
        require_same(tmp_path, dataclasses.replace(config, noise=0.1))


def test_what_cannot_be_resumed_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no run to resume: it has no config.json. Start without --resume"):
        RunFolder(RunConfig(log_dir=tmp_path, resume=True), "p")
    begun(tmp_path)
    (tmp_path / "weights.pt").touch()
    with pytest.raises(ValueError, match="finished run without its checkpoint.pt.*--overwrite"):
        RunFolder(RunConfig(log_dir=tmp_path, resume=True), "p")
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(ValueError, match="config.json is damaged"):
        RunFolder(RunConfig(log_dir=tmp_path, resume=True), "p")


class Killed(BaseException):
    """What stops a process."""


def test_an_overwrite_that_is_killed_leaves_no_results_beside_other_options(tmp_path, monkeypatch):
    """Killed before every removal in turn, and before the new options are written."""
    unlink, moments = Path.unlink, 0

    def until(moment):
        calls = iter(range(moment))

        def mortal(self, missing_ok=False):
            if self.name.startswith("."):
                return unlink(self, missing_ok=missing_ok)
            if next(calls, None) is None:
                raise Killed
            return unlink(self, missing_ok=missing_ok)

        return mortal

    for moment in range(20):
        path = tmp_path / str(moment)
        begun(path, seed=1)
        (path / "figures").mkdir()
        old = ["metrics.json", "weights.pt", "checkpoint.pt", "figures/unseen.png", "events.out.tfevents.1"]
        for name in (*old, "training.log"):
            (path / name).write_text("of seed 1")
        folder = RunFolder(RunConfig(log_dir=path, overwrite=True, seed=2), "p")
        assert (path / "checkpoint.pt").exists()  # nothing goes before the training begins
        with monkeypatch.context() as patched:
            patched.setattr(Path, "unlink", until(moment))
            try:
                folder.begin(RunConfig())
            except Killed:
                moments += 1
                assert read_seed(path) in (1, None)
                continue
            finally:
                folder.release()
        assert read_seed(path) == 2 and not any((path / name).exists() for name in old)
        assert (path / "training.log").exists()
        break
    assert moments == 6  # five files and the options


def read_seed(path):
    file = path / "config.json"
    return json.loads(file.read_text())["seed"] if file.exists() else None


def test_what_ran_is_kept_for_every_start(tmp_path):
    begun(tmp_path, quick=True)
    begun(tmp_path, quick=True, resume=True)
    written = json.loads((tmp_path / "config.json").read_text())
    assert [set(ran) for ran in written["ran"]] == [{"effective", "versions", "command", "time"}] * 2
    assert written["episodes"] == 20 and written["ran"][0]["effective"]["episodes"] == 3
    assert written["ran"][0]["versions"]["torch"].split("+")[0] == torch.__version__.split("+")[0]
    settings = read_settings(tmp_path)
    assert settings["plant"] == "p"
    options = {name: value for name, value in settings.items() if name not in BESIDE}
    assert config_of(RunConfig, options) == RunConfig(log_dir=tmp_path, quick=True, resume=True)
