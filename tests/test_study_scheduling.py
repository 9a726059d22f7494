"""The study's tasks side by side: processes, progress and failures."""

import os
import time

import pytest
from handwritten_study import WRITE_RESULTS, training, written

from rt_torchrl.study import scheduling
from rt_torchrl.study.scheduling import side_by_side


def test_trainings_run_side_by_side(tmp_path):
    script = written(tmp_path / "tiny.py", WRITE_RESULTS)
    trainings = [training(tmp_path, seed, recipe=script) for seed in range(2)]
    side_by_side([[task] for task in trainings], jobs=2)
    assert os.getpid() not in [t.metrics()["process"] for t in trainings]


class Counted:
    """A task that writes a file when it is run."""

    def __init__(self, path):
        self.path = path

    def run(self):
        with self.path.open("a") as file:
            file.write(f"{os.getpid()}\n")

    def done(self):
        return self.path.exists()


def test_a_batch_runs_in_one_process_and_the_bar_counts_tasks(tmp_path, capsys):
    batches = [[Counted(tmp_path / f"{batch}-{task}") for task in range(3)] for batch in range(2)]
    batches[0][0].run()
    side_by_side(batches, jobs=2)
    workers = [[task.path.read_text().split()[-1] for task in batch] for batch in batches]
    assert all(len(set(found)) == 1 for found in workers)
    shown = capsys.readouterr().err
    assert "1/6" in shown and "6/6" in shown


class Slow(Counted):
    """A task that takes several glances of the bar."""

    def run(self):
        time.sleep(0.3)
        super().run()


def test_the_bar_moves_inside_a_batch(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(scheduling, "GLANCE", 0.05)
    side_by_side([[Slow(tmp_path / str(task)) for task in range(3)]], jobs=1)
    shown = capsys.readouterr().err
    assert all(f"{done}/3" in shown for done in range(4))


def test_a_task_that_fails_stops_no_other(tmp_path):
    failing = training(tmp_path, 7, recipe=written(tmp_path / "fails.py", "raise ValueError('no rotor')"))
    others = [Counted(tmp_path / "first"), Counted(tmp_path / "second")]
    with pytest.raises(RuntimeError, match=r"1 failed, the others are kept:\nRuntimeError: .*fails.py .* no rotor"):
        side_by_side([[failing, others[0]], [others[1]]], jobs=1)
    assert all(task.done() for task in others)


class Leaving(Counted):
    """A task that ends the process, as a command line with an unknown option does."""

    def run(self):
        raise SystemExit(2)


def test_a_task_that_leaves_stops_no_other(tmp_path):
    other = Counted(tmp_path / "other")
    with pytest.raises(RuntimeError, match=r"1 failed, the others are kept:\nSystemExit: 2"):
        side_by_side([[Leaving(tmp_path / "leaving"), other]], jobs=1)
    assert other.done()
