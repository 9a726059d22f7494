"""The study on a Ray cluster of two nodes: equal results, workers that die, tasks that fail, Ctrl-C."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from handwritten_study import training, written
from mortal_tasks import PATIENCE, Mortal, Unreadable, Waiting, wait_until

from rt_torchrl.study.scheduling import side_by_side

ray = pytest.importorskip("ray", reason="the study's Ray cluster needs the extra ray")
pytestmark = pytest.mark.slow

TESTS = Path(__file__).resolve().parent
PATHS = os.pathsep.join([str(TESTS), str(TESTS.parent), os.environ.get("PYTHONPATH", "")])
TRAIN = f"""
    import sys
    with open(config.log_dir / "workers", "a") as file:
        print(os.getpid(), file=file)
    sys.path.insert(0, {str(TESTS)!r})
    from small_runs import small_run
    options = dict(seed=config.seed, overwrite=config.overwrite, resume=config.resume, untrained=0)
    small_run(config.log_dir, config.episodes, **options).train()
    (config.log_dir / "config.json").unlink()
"""
"""Main of a recipe that trains for seconds, and says in which processes; its options are not those of the recipe."""


@pytest.fixture(scope="module")
def cluster():
    """Two nodes with one core each, whose workers can import the tests."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = PATHS
    found = started_cluster()
    yield found
    found.shutdown()
    if before is None:
        del os.environ["PYTHONPATH"]
    else:
        os.environ["PYTHONPATH"] = before


def started_cluster():
    """A node has 30 s to start, which Ray states nowhere to change; beside other tests it can take longer."""
    from ray.cluster_utils import Cluster

    for attempt in range(3):
        found = Cluster()
        try:
            for _ in range(2):
                found.add_node(num_cpus=1)
            return found
        except Exception as error:
            found.shutdown()
            if "timed out during startup" not in str(error) or attempt == 2:
                raise
    raise AssertionError


def alive(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def workers_of(task):
    """Processes that have begun a training, in their order."""
    log = task.folder / "workers"
    return log.read_text().split() if log.exists() else []


def results_of(task):
    """Results of a training without its times."""
    metrics = task.metrics()
    del metrics["summary"]["seconds"]
    return [{**record, "seconds": None} for record in metrics["episodes"]], metrics["summary"]


def trained(folder, backend, **options):
    """Two trainings of equal seeds in every folder."""
    folder.mkdir()
    recipe = written(folder / "small.py", TRAIN)
    found = [training(folder, seed, recipe=recipe, episodes=12) for seed in range(2)]
    side_by_side([[task] for task in found], backend=backend, jobs=2, **options)
    return found


def test_trainings_end_as_on_one_machine_though_a_worker_is_killed(tmp_path, cluster, capsys):
    """Another worker goes on from the last whole episode, to the same results to the bit."""
    victim = training(tmp_path / "there", 1)

    def kill():
        wait_until((victim.folder / "checkpoint.pt").exists)
        os.kill(int(workers_of(victim)[0]), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    there = trained(tmp_path / "there", "ray", ray_address=cluster.address)
    killer.join()
    assert len(set(workers_of(victim))) == 2 and "--resume" in (victim.folder / "training.log").read_text()
    assert len(workers_of(there[0])) == 1 and str(os.getpid()) not in workers_of(there[0]) + workers_of(victim)
    assert f"1 of 3 workers died over the training in {victim.folder}" in capsys.readouterr().err
    here = trained(tmp_path / "here", "loky")
    assert [results_of(task) for task in there] == [results_of(task) for task in here]
    assert results_of(there[0]) != results_of(there[1])


def test_each_task_ends_once_whatever_dies_beside_it(tmp_path, cluster):
    whole, wrong, once, after = (
        Mortal(tmp_path / "whole"),
        Mortal(tmp_path / "wrong", error=ValueError("no rotor")),
        Mortal(tmp_path / "once", deaths=1),
        Mortal(tmp_path / "after"),
    )
    deadly, last = Mortal(tmp_path / "deadly", deaths=99), Mortal(tmp_path / "last")
    with pytest.raises(RuntimeError) as failed:
        side_by_side([[whole, wrong, once, after], [deadly, last]], backend="ray", ray_address=cluster.address)
    head, *failures = str(failed.value).splitlines()
    assert head == "2 failed, the others are kept:" and "ValueError: no rotor" in failures
    assert any(re.match("3 of 3 workers died over task deadly. ActorDiedError: ", line) for line in failures)
    assert [task.done() for task in (whole, wrong, once, after, deadly, last)] == [True, False, True, True, False, True]
    assert [len(task.begun()) for task in (whole, wrong, once, after, deadly, last)] == [1, 1, 2, 1, 3, 1]
    # A worker keeps its batch, so that a training finds compiled what the one before has compiled.
    assert whole.begun() == wrong.begun() == once.begun()[:1] and after.begun() == once.begun()[1:]


def test_a_task_that_no_worker_can_read_fails(tmp_path, cluster):
    other = Mortal(tmp_path / "other")
    with pytest.raises(RuntimeError, match=r"1 failed, the others are kept:\n.*task unreadable.*own_plant"):
        side_by_side([[Unreadable(tmp_path / "unreadable"), other]], backend="ray", ray_address=cluster.address)
    assert other.done()


def test_a_folder_that_the_machines_do_not_share_is_named(tmp_path, cluster, monkeypatch):
    """Here the folder has gone by the time a worker enters it."""
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setattr(os, "getcwd", lambda: str(folder))
    folder.rmdir()
    with pytest.raises(RuntimeError, match=r"cannot enter .*gone.* on a file system that they share"):
        side_by_side([[Mortal(tmp_path / "task")]], backend="ray", ray_address=cluster.address)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="the processes of the cluster are looked up in /proc")
def test_tasks_of_a_node_that_is_lost_are_done_on_another(tmp_path, cluster):
    node = cluster.add_node(num_cpus=1)
    tasks = [Waiting(tmp_path / str(task)) for task in range(3)]

    def lose():
        wait_until(lambda: all(task.begun() for task in tasks))
        cluster.remove_node(node, allow_graceful=False)
        # The worker outlives its node for a moment, in which it must not get the sign.
        wait_until(lambda: not all(alive(int(task.begun()[0])) for task in tasks))
        (tmp_path / "go").touch()

    loser = threading.Thread(target=lose)
    loser.start()
    side_by_side([[task] for task in tasks], backend="ray", jobs=3, ray_address=cluster.address)
    loser.join()
    assert all(task.done() for task in tasks)
    assert sorted(len(task.begun()) for task in tasks) == [1, 1, 2]


def test_a_cluster_that_does_not_answer_is_refused():
    begin = time.monotonic()
    with pytest.raises(ValueError, match="Ray cluster at 127.0.0.1:1 does not answer .* or correct the address"):
        side_by_side([], backend="ray", ray_address="127.0.0.1:1")
    assert time.monotonic() - begin < 20.0


STUDY = """
from dataclasses import dataclass
from pathlib import Path
from mortal_tasks import Mortal, Waiting
from rt_torchrl import main_of
from rt_torchrl.study.scheduling import side_by_side

@dataclass(frozen=True, kw_only=True)
class Config:
    folder: Path

def main(config):
    tasks = [Mortal(config.folder / "whole"), Waiting(config.folder / "cut"), Waiting(config.folder / "short")]
    side_by_side([[task] for task in tasks], backend="ray", jobs=2)

if __name__ == "__main__":
    main_of(Config, main)
"""


def processes_below(process):
    """Processes that a process has started, and those that they have started, with their command lines."""
    table = subprocess.run(["ps", "-eo", "pid=,ppid=,args="], capture_output=True, text=True, check=True).stdout
    rows = {int(pid): (int(parent), command) for pid, parent, command in (x.split(None, 2) for x in table.splitlines())}
    found = {process}
    while more := {child for child, (parent, _) in rows.items() if parent in found} - found:
        found |= more
    return {child: rows[child][1] for child in found - {process}}


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="the processes of the cluster are looked up in /proc")
def test_ctrl_c_leaves_what_is_done_and_no_process(tmp_path):
    """In a cluster that the study has started itself. A terminal gives Ctrl-C to every process of its group."""
    (tmp_path / "study.py").write_text(STUDY)
    # As the documentation prints it. Ray would start every worker by uv too, in a copy of the folder.
    python = ["uv", "run", "--no-sync", "python"] if shutil.which("uv") else [sys.executable]
    process = subprocess.Popen(
        [*python, tmp_path / "study.py", "--folder", "."],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": PATHS, "VIRTUAL_ENV": sys.prefix},
        start_new_session=True,
    )
    begun = [tmp_path / "cut.log", tmp_path / "short.log"]
    try:
        wait_until(lambda: process.poll() is not None or all(log.exists() and log.read_text() for log in begun))
        assert process.poll() is None
        below = processes_below(process.pid)
        assert {int(log.read_text()) for log in begun} <= set(below)
        assert not [command for command in below.values() if "uv run" in command]
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(PATIENCE) == 130
        wait_until(lambda: not any(map(alive, below)))
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert json.loads((tmp_path / "whole").read_text()) == {"begun": 1}
    assert not (tmp_path / "cut").exists() and not (tmp_path / "short").exists()
