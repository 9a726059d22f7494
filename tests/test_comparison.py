"""Finished runs side by side."""

import json

import numpy as np
import pytest

from rt_torchrl.study.comparison import comparison_figure, comparison_table, entries_of

KINDS = {"model_based": 1.0, "model_free": 3.0}


def leave(folder, *, arm, seed, costs, plant="tanks", hidden=(16,)):
    """The files of a finished run that a comparison reads."""
    folder.mkdir()
    settings = {"plant": plant, "recipe": {}, "seed": seed, "hidden": hidden, "twinning": {"arm": arm}, "ran": [seed]}
    (folder / "config.json").write_text(json.dumps(settings))
    unseen = {
        "episodes": len(costs),
        "costs": {"model_based": costs, "model_free": [9.0] * len(costs), "PI": [2.0] * len(costs)},
        "merit": {"model_based": {"power [W]": {"mean": seed}}, "model_free": {"power [W]": {"mean": 0.0}}},
        "baselines": {"PI": {"merit": {"power [W]": {"mean": 5.0}}}},
    }
    episodes = [{"real_cost": cost, "J_a_unseen": cost / 2.0} for cost in (4.0, 2.0)]
    metrics = {"plant": plant, "episodes": episodes, "summary": {"live": "model_based", "unseen": unseen}}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def four(tmp_path):
    return [
        leave(tmp_path / f"{arm}-{seed}", arm=arm, seed=seed, costs=[mean - 0.5, mean + 0.5 + seed])
        for arm, mean in KINDS.items()
        for seed in (0, 1)
    ]


def test_runs_that_differ_in_the_seed_are_one_row(tmp_path):
    runs, controllers = entries_of(four(tmp_path))
    assert [entry.name for entry in runs] == ["arm model-based", "arm model-free"]
    np.testing.assert_allclose([entry.mean for entry in runs], [1.25, 3.25])
    assert [entry.merit["power [W]"] for entry in runs] == [0.5, 0.5]
    assert [(entry.name, entry.mean) for entry in controllers] == [("PI", 2.0)]
    assert runs[0].curves == [[2.0, 1.0]] * 2
    table = [line.split() for line in comparison_table(runs, controllers).splitlines()]
    assert table[1][:4] == ["arm", "model-based", "2", "1.25"] and table[3][:2] == ["PI", "2"]
    low, high = runs[0].interval()
    assert 0.5 <= low < 1.25 < high <= 2.5


def test_the_figure_has_a_line_for_each_row(tmp_path):
    runs, controllers = entries_of(four(tmp_path))
    (ax,) = comparison_figure(runs, controllers, "t").axes
    assert {line.get_label(): np.mean(line.get_ydata()) for line in ax.lines} == {
        "arm model-based": 1.5,
        "arm model-free": 1.5,
        "PI": 2.0,
    }


def test_a_policy_that_diverged_on_the_way_is_drawn(tmp_path):
    """``metrics.json`` holds null for it."""
    folders = four(tmp_path)
    for folder in folders:
        metrics = json.loads((folder / "metrics.json").read_text())
        metrics["episodes"][0]["J_a_unseen"] = None
        (folder / "metrics.json").write_text(json.dumps(metrics))
    runs, controllers = entries_of(folders)
    assert runs[0].curves == [[np.inf, 1.0]] * 2
    comparison_figure(runs, controllers, "t").canvas.draw()


def test_runs_that_cannot_be_compared_are_refused(tmp_path):
    first = leave(tmp_path / "a", arm="twinning", seed=0, costs=[1.0, 2.0])
    with pytest.raises(ValueError, match=r"differ in their plant \(tanks, drone\)"):
        entries_of([first, leave(tmp_path / "b", arm="twinning", seed=0, costs=[1.0, 2.0], plant="drone")])
    with pytest.raises(ValueError, match=r"differ in their number of unseen episodes \(2, 3\)"):
        entries_of([first, leave(tmp_path / "c", arm="twinning", seed=0, costs=[1.0, 2.0, 3.0])])
    (first / "metrics.json").unlink()
    with pytest.raises(ValueError, match="has no metrics.json: it is not finished"):
        entries_of([first])


def on_the_twin(folder, **real):
    """Make a finished run one that was judged on its own twin."""
    file = folder / "metrics.json"
    metrics = json.loads(file.read_text())
    metrics["summary"]["unseen"]["judged_on"] = "twin"
    metrics["summary"] |= real
    file.write_text(json.dumps(metrics))
    return folder


def test_costs_on_different_twins_are_not_compared(tmp_path):
    folders = [leave(tmp_path / f"{seed}", arm="model_based", seed=seed, costs=[1.0, 2.0]) for seed in (0, 1)]
    for folder in folders:
        on_the_twin(folder)
    with pytest.raises(ValueError, match="judged on its own twin alone.*--real-unseen"):
        entries_of(folders)
    found = {"episodes": 2, "J_a": {"mean": 5.0}, "merit": {"power [W]": {"mean": 8.0}}}
    real = {"controllers": {"model_based": found, "PI": found}, "costs": {"model_based": [4.0, 6.0], "PI": [7.0, 9.0]}}
    runs, controllers = entries_of([on_the_twin(folder, real_unseen=real) for folder in folders])
    assert [(entry.name, entry.mean) for entry in (*runs, *controllers)] == [(runs[0].name, 5.0), ("PI", 8.0)]
    simulated = leave(tmp_path / "2", arm="model_based", seed=2, costs=[1.0, 2.0])
    with pytest.raises(ValueError, match="differ in their place of the unseen episodes"):
        entries_of([*folders, simulated])
