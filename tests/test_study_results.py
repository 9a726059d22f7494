"""Rows of the study and their intervals, from trainings that are written by hand."""

import json

import numpy as np
import pytest
from handwritten_study import EPISODES, finished

from rt_torchrl.atomic_file import finite
from rt_torchrl.study import page, tables
from rt_torchrl.study.results import Entry, arm_entry, difference, mean_interval, weight_error


def test_an_arm_is_judged_by_the_policy_that_acts(tmp_path):
    entry = arm_entry("twinning", [finished(tmp_path, seed, 0.1 * seed) for seed in range(3)])
    assert entry.costs.shape == (3, EPISODES)
    assert entry.mean == pytest.approx(entry.costs.mean(1).mean())
    assert entry.weight_error == pytest.approx([0.1] * 3) and entry.J_p_ratio == [1e-3] * 3
    assert entry.episodes_to(1.0) == [2, 2, 2] and entry.episodes_to(0.5) == [None] * 3
    assert entry.twin_errors == [pytest.approx([0.05, 0.0105, 0.01])] * 3
    low, high = entry.interval()
    assert low < entry.mean < high


def test_an_unseen_episode_that_diverges_costs_infinitely(tmp_path):
    """``metrics.json`` holds null there; the study must not fail, and the mean must not pass it over."""
    found = [finished(tmp_path, seed, 0.1 * seed) for seed in range(2)]
    metrics = found[1].metrics()
    live = metrics["summary"]["live"]
    metrics["summary"]["unseen"]["costs"][live][3] = None
    for values in metrics["summary"]["unseen"]["merit"][live].values():
        values["mean"] = None
    (found[1].folder / "metrics.json").write_text(json.dumps(metrics))
    entry = arm_entry("twinning", found)
    assert np.isposinf(entry.mean) and np.isfinite(entry.costs[0]).all()
    assert all(np.isnan(value) for value in entry.merit.values())
    low, high = entry.interval()
    assert np.isposinf(high) and not np.isnan(low)
    assert tables.cost_cells(entry)[0] == "inf"


def test_intervals_cover_the_mean_as_often_as_they_say():
    rng, hits = np.random.default_rng(0), 0
    for _ in range(40):
        low, high = mean_interval(rng.standard_normal((1, 60)))
        hits += low < 0.0 < high
    # 95 % of 40 is 38; fewer than 33 has a probability of 1e-3.
    assert hits >= 33


def test_differences_are_paired_by_episode():
    rng = np.random.default_rng(0)
    hard = 10.0 * rng.random((1, 50))
    first, second = (Entry(name=name, costs=hard + shift, merit={}) for name, shift in (("a", 0.1), ("b", 0.0)))
    # Episodes differ by ten, the controllers by a tenth in each.
    assert difference(first, second) == pytest.approx((0.1, 0.1))
    with pytest.raises(ValueError, match="a was judged on 50 unseen episodes, c on 3"):
        difference(first, Entry(name="c", costs=np.ones((1, 3)), merit={}))


def test_a_closure_of_another_kind_has_no_weight_error():
    assert weight_error({"found": {"a": 1.0}, "true": {"c1": 2.0}}) is None
    assert weight_error({"found": {"a": 1.0}, "true": None}) is None


def test_weights_that_the_real_system_has_beside_those_of_the_closure_count_for_nothing():
    """Such as the offset of a sensor, of which the plant's own closure knows nothing."""
    assert weight_error({"found": {"a": 1.1}, "true": {"a": 1.0, "pressure_offset": 15e3}}) == pytest.approx(0.1)


def test_a_twin_that_diverges_has_an_infinite_error(tmp_path):
    """Its J_p is null in the metrics, and in the numbers of the study."""
    found = finished(tmp_path, 0, 0.0)
    metrics = found.metrics()
    metrics["episodes"][-1]["J_p"] = None
    (found.folder / "metrics.json").write_text(json.dumps(metrics))
    entry = arm_entry("twinning", [found])
    assert entry.twin_errors[0][-1] == float("inf") and entry.twin_errors[0][0] == pytest.approx(0.05)
    assert finite(page.numbers_of(entry))["J_p"][0][-1] is None
