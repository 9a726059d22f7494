"""The trust ratio, table-tested on scripted costs."""

import pytest

from rt_torchrl.twinning.referees import Evidence, RefereeConfig, TrustRatio

MOVING, STALLED = 0.9, 0.1


def evidence(ratio, *, live=1.0, idle=2.0, change=MOVING, predicted=0.5):
    """Two real episodes of which the second costs by ``ratio`` times the predicted change more than the first."""
    return Evidence(
        live_cost=live,
        idle_cost=idle,
        idle_weight_change=change,
        real_costs=(3.0, 3.0 + ratio * predicted),
        predicted_costs=lambda: (2.0, 2.0 + predicted),
    )


@pytest.mark.parametrize(
    "ratio, doubts", [(1.0, 0), (0.0, 0), (40.0, 0), (40.1, 1), (-0.1, 1), (-1e6, 1), (float("inf"), 1)]
)
def test_the_band_holds_its_ends(ratio, doubts):
    referee = TrustRatio(RefereeConfig())
    referee.decide(evidence(ratio))
    assert referee.doubt_count == doubts


def test_who_acts_follows_the_twin_while_it_is_trusted():
    referee = TrustRatio(RefereeConfig())
    assert referee.decide(evidence(1.0, live=2.0, idle=1.0)) == "swap" and referee.live == "model_based"
    assert referee.decide(evidence(1.0, live=1.0, idle=2.0)) == "keep" and referee.live == "model_based"
    # Equal costs are no reason to swap.
    assert referee.decide(evidence(1.0, live=1.0, idle=1.0)) == "keep"


def test_doubt_outlasts_the_patience_before_the_model_free_policy_acts_and_one_good_episode_ends_it():
    referee = TrustRatio(RefereeConfig(), live="model_based")
    events = [referee.decide(evidence(-1.0)) for _ in range(4)]
    # Patience 2: the third doubt in a row takes the role away, though the twin says the live policy is better.
    assert events == ["keep", "keep", "swap", "keep"] and referee.live == "model_free" and not referee.trusted
    # While in doubt, a model-based policy that is better on the twin does not act.
    assert referee.decide(evidence(-1.0, live=2.0, idle=1.0)) == "keep" and referee.live == "model_free"
    assert referee.decide(evidence(1.0, live=2.0, idle=1.0)) == "swap" and referee.live == "model_based"
    assert referee.trusted and referee.doubt_count == 0


def test_an_episode_without_a_predicted_change_says_nothing():
    referee = TrustRatio(RefereeConfig())
    referee.decide(evidence(-1.0))
    referee.decide(evidence(5.0, predicted=0.0))
    assert referee.doubt_count == 1
    first = Evidence(live_cost=1.0, idle_cost=2.0, idle_weight_change=MOVING, real_costs=(3.0,))
    referee.decide(first)
    assert referee.doubt_count == 1


def test_a_stalled_idle_policy_becomes_a_clone_as_in_the_tree_and_not_while_in_doubt():
    referee = TrustRatio(RefereeConfig(clone_patience=1))
    assert [referee.decide(evidence(1.0, change=STALLED)) for _ in range(3)] == ["keep", "clone", "keep"]
    doubting = TrustRatio(RefereeConfig(clone_patience=0, patience=0))
    assert doubting.decide(evidence(-1.0, live=2.0, idle=1.0, change=STALLED)) == "keep"


def test_a_twin_that_diverges_under_a_flown_policy_is_doubted():
    found = evidence(1.0)
    diverged = Evidence(
        live_cost=1.0,
        idle_cost=2.0,
        idle_weight_change=MOVING,
        real_costs=found.real_costs,
        predicted_costs=lambda: (2.0, float("inf")),
    )
    referee = TrustRatio(RefereeConfig())
    referee.decide(diverged)
    assert referee.doubt_count == 1


@pytest.mark.parametrize("band", [(1.0, 1.0), (2.0, 0.0), (float("nan"), 1.0)])
def test_a_band_without_width_is_refused(band):
    with pytest.raises(ValueError, match="band"):
        RefereeConfig(band=band)
