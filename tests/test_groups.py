"""Groups of lanes: their work is shared among threads, once each, and a failure of any of them is raised."""

import threading

import numpy as np
import pytest
import torch

from rt_torchrl.trajectories.engines.code import Group, for_each_group
from rt_torchrl.trajectories.rollout import all_finite


@pytest.fixture(params=[1, 2, 4])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_every_group_is_worked_once(threads):
    found = []
    for_each_group(21, 8, found.append)
    assert sorted(found) == [Group(0, 8, 8), Group(8, 16, 8), Group(16, 21, 8)]


def test_groups_run_at_the_same_time():
    torch_threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        meeting = threading.Barrier(2, timeout=20.0)  # which one thread alone would wait for in vain
        for_each_group(2, 1, lambda group: meeting.wait() and None)
    finally:
        torch.set_num_threads(torch_threads)


@pytest.mark.parametrize("failing", [0, 8, 16])
def test_a_failure_is_raised_when_nobody_works_any_more(threads, failing):
    working = []

    def work(group):
        working.append(group)
        try:
            if group.first == failing:
                raise ArithmeticError(f"group {group.first}")
        finally:
            working.remove(group)

    with pytest.raises(ArithmeticError, match=f"group {failing}"):
        for_each_group(21, 8, work)
    assert not working


def test_lanes_are_gathered_and_scattered():
    rows = np.arange(2 * 5 * 3, dtype=float).reshape(2, 5, 3)
    group, found = Group(2, 5, 4), np.zeros((2, 5, 3))
    lanes = group.gather(rows[..., :1], rows[..., 1:])
    np.testing.assert_array_equal(lanes[1, :, 2], rows[1, 4])
    np.testing.assert_array_equal(lanes[..., 3], lanes[..., 2])  # what is left repeats the last realisation
    group.scatter(lanes, found)
    np.testing.assert_array_equal(found[:, 2:], rows[:, 2:])
    assert not found[:, :2].any()


@pytest.mark.parametrize("odd", [float("nan"), float("inf"), -float("inf")])
def test_a_number_that_is_not_finite_is_found(odd):
    x = torch.ones(3, 4, dtype=torch.float64, requires_grad=True)
    assert all_finite(x) and all_finite(x.t()) and all_finite(x[:0]) and all_finite(1e308 * x)
    with torch.no_grad():
        x[1, 2] = odd
    assert not all_finite(x)
