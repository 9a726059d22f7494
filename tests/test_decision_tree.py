"""The decision tree of step 6, table-tested on scripted costs."""

import math

import pytest

from rt_torchrl.steps.config import RefereeConfig
from rt_torchrl.steps.switch import DecisionTree, Evidence

WORSE, BETTER, EQUAL = (2.0, 1.0), (1.0, 2.0), (1.0, 1.0)
MOVING, STALLED = 0.9, 0.1


def evidence(live_cost, idle_cost, change):
    return Evidence(live_cost=live_cost, idle_cost=idle_cost, idle_weight_change=change)


def play(config, script, live="model_free"):
    """Events and counters of a script of ((live cost, idle cost), weight change)."""
    referee, found = DecisionTree(config, live=live), []
    for costs, change in script:
        event = referee.decide(evidence(*costs, change))
        found.append((event, referee.worse_count, referee.stall_count))
    return found, referee


@pytest.mark.parametrize(
    "script, expected",
    [
        # Worse: C_π counts, and the third time in a row exceeds P_π = 2.
        ([(WORSE, MOVING)] * 4, [("keep", 1, 0), ("keep", 2, 0), ("swap", 0, 0), ("keep", 1, 0)]),
        # A better episode in between restarts C_π.
        (
            [(WORSE, MOVING)] * 2 + [(BETTER, MOVING)] + [(WORSE, MOVING)] * 3,
            [("keep", 1, 0), ("keep", 2, 0), ("keep", 0, 0), ("keep", 1, 0), ("keep", 2, 0), ("swap", 0, 0)],
        ),
        # Better and stalled: C_w counts, and the fourth time in a row exceeds P_w = 3.
        (
            [(BETTER, STALLED)] * 5,
            [("keep", 0, 1), ("keep", 0, 2), ("keep", 0, 3), ("clone", 0, 0), ("keep", 0, 1)],
        ),
        # Movement restarts C_w.
        (
            [(BETTER, STALLED)] * 3 + [(BETTER, MOVING), (BETTER, STALLED)],
            [("keep", 0, 1), ("keep", 0, 2), ("keep", 0, 3), ("keep", 0, 0), ("keep", 0, 1)],
        ),
        # So does a worse live policy: the branch of the clone is not reached, stalled or not.
        (
            [(BETTER, STALLED)] * 3 + [(WORSE, STALLED), (BETTER, STALLED)],
            [("keep", 0, 1), ("keep", 0, 2), ("keep", 0, 3), ("keep", 1, 0), ("keep", 0, 1)],
        ),
        # Equal costs are not worse; a change equal to T_w is no stall.
        ([(EQUAL, MOVING), (EQUAL, 0.5), (EQUAL, 0.4999)], [("keep", 0, 0), ("keep", 0, 0), ("keep", 0, 1)]),
        # An infinite cost is worse than any other.
        ([((math.inf, 1.0), MOVING), ((1.0, math.inf), MOVING)], [("keep", 1, 0), ("keep", 0, 0)]),
    ],
)
def test_every_branch(script, expected):
    assert play(RefereeConfig(), script)[0] == expected


@pytest.mark.parametrize("patience", [0, 1, 4])
def test_swap_and_clone_need_more_than_their_patience(patience):
    config = RefereeConfig(patience=patience, clone_patience=patience)
    for costs, event in ((WORSE, "swap"), (BETTER, "clone")):
        events = [e for e, *_ in play(config, [(costs, STALLED)] * (2 * patience + 2))[0]]
        assert events == (["keep"] * patience + [event]) * 2


@pytest.mark.parametrize("live, other", [("model_free", "model_based"), ("model_based", "model_free")])
def test_roles_exchange_and_only_by_a_swap(live, other):
    referee = play(RefereeConfig(), [(WORSE, MOVING)] * 2, live)[1]
    assert (referee.live, referee.idle) == (live, other)
    referee.decide(evidence(*WORSE, MOVING))
    assert (referee.live, referee.idle) == (other, live)
    referee = play(RefereeConfig(clone_patience=0), [(BETTER, STALLED)], live)[1]
    assert (referee.live, referee.idle) == (live, other)


@pytest.mark.parametrize("live_cost, event", [(0.99, "keep"), (1.0, "keep"), (1.01, "swap")])
def test_the_live_policy_is_worse_where_it_costs_more(live_cost, event):
    assert DecisionTree(RefereeConfig(patience=0)).decide(evidence(live_cost, 1.0, MOVING)) == event


@pytest.mark.parametrize("position, name", list(enumerate(["live_cost", "idle_cost", "idle_weight_change"])))
def test_nan_is_refused_and_leaves_the_counters(position, name):
    referee = play(RefereeConfig(), [(WORSE, MOVING)])[1]
    arguments = [1.0, 1.0, 1.0]
    arguments[position] = math.nan
    with pytest.raises(ValueError, match=f"{name} of step 6 is NaN"):
        referee.decide(evidence(*arguments))
    assert (referee.live, referee.worse_count, referee.stall_count) == ("model_free", 1, 0)
