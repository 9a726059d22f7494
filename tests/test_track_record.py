"""What is remembered of real episodes: the latest ones, and of the earlier ones those that contradict the twin."""

import math

import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from test_algorithm import twinning

from rt_torchrl.optimisers.descent import DescentConfig
from rt_torchrl.steps.belief import LATEST, REFUTING, TrackRecord
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.plan import PlannerConfig
from rt_torchrl.systems.exploration import ExplorationConfig
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.evidence.alarm import BEYOND_CHANCE
from rt_torchrl.twinning.evidence.paired_differences import EXPLORED


class AlwaysOne(VirtualEpisodes):
    """Virtual episodes of a twin that says 1 of every policy, and counts its flights."""

    flights = 0

    def __init__(self):
        plant = LinearQuadratic(horizon=2.0)
        self.twin = DigitalTwin(plant, LinearClosure(plant.true_closure))

    def cost(self, policy, episodes):
        self.flights += 1
        return torch.ones((), dtype=torch.float64)

    def repeated(self, record):
        return record


def flown(*costs, gains=None, exploration=0.0, found=None):
    """A track record after these costs, each flown with a gain of its own, and examined after each."""
    found = found or TrackRecord({"model_based": LinearGain([[0.0, 0.0]])})
    for cost, gain in zip(costs, gains or range(len(costs)), strict=True):
        weights = {"gain": torch.tensor([[gain, 0.0]], dtype=torch.float64)}
        trajectory = (torch.zeros(2, 2).double(), torch.zeros(1, 1).double(), torch.zeros(1, 1).double())
        found.append(Trajectory(*trajectory), "model_based", cost, exploration, weights)
        found.weigh(found.differences(AlwaysOne()))
    return found


def kept(found):
    """Costs of the episodes of the paired differences, of which the first ones are earlier than the latest."""
    differences = found.differences(AlwaysOne())
    costs = [one.cost for one in differences.flown]
    return costs[: differences.earlier], costs[differences.earlier :]


def test_what_contradicts_the_twin_outlasts_the_latest_episodes():
    latest = [1.0 + 0.001 * k for k in range(LATEST)]
    assert kept(flown(1.05, 3.0, 0.2, 1.1, 2.0, *latest)) == ([3.0, 2.0], latest)


def test_what_exploration_explains_does_not():
    spread, latest = 0.1, [1.0] * LATEST
    beyond = [math.exp(BEYOND_CHANCE + 2.0 * EXPLORED * spread + sign * 0.01) for sign in (-1.0, 1.0)]
    assert kept(flown(*beyond, *latest, exploration=spread)) == (beyond[1:], latest)


def test_of_many_those_stay_that_contradict_the_twin_most():
    dear = [2.0 + 0.1 * (k * 7 % 13) for k in range(REFUTING + 3)]
    found = flown(*dear, *[1.0] * LATEST)
    assert kept(found)[0] == [cost for cost in dear if cost in sorted(dear)[3:]]


def test_weights_that_flew_again_are_kept_once():
    """Of two flights with the same weights, the one that contradicts the twin more."""
    found = flown(2.0, 3.0, 2.5, *[1.0] * LATEST, gains=[5, 5, 6, *range(LATEST)])
    assert kept(found)[0] == [3.0, 2.5]


def test_what_the_twin_explains_now_is_forgotten():
    found = flown(3.0, *[1.0] * LATEST)
    assert kept(found)[0] == [3.0]
    explained = found.differences(AlwaysOne())._replace(values=[0.0] * (LATEST + 1))
    found.weigh(explained)
    assert kept(flown(1.0, gains=[0.5], found=found))[0] == []


def test_episodes_fly_again_where_the_twin_or_they_are_new():
    found, virtual = flown(2.0, 3.0), AlwaysOne()
    found.differences(virtual)
    assert virtual.flights == 0  # the other twin had the same weights
    with torch.no_grad():
        virtual.twin.closure.matrix[0, 0] += 1e-12
    assert [found.differences(virtual).values for _ in range(2)] == [[math.log(2.0), math.log(3.0)]] * 2
    assert virtual.flights == 2
    flown(1.0, found=found).differences(virtual)
    assert virtual.flights == 5


class Profit(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous) - 100.0


@pytest.mark.parametrize("arm", ["twinning", "model_based"])
def test_a_real_episode_of_negative_cost_is_refused_where_a_twin_says_what_it_costs(arm):
    found = twinning(Profit(horizon=2.0), arm=arm)
    with pytest.raises(
        ValueError, match=r"J_a=-\d+.* of a real episode of plant 'linear_quadratic' is negative.* add a constant"
    ):
        found.episode()


def test_without_a_twin_costs_may_be_negative():
    assert twinning(Profit(horizon=2.0), arm="model_free").episode()["real_cost"] < 0.0


def test_a_saved_record_goes_on_alike():
    first, again = flown(3.0, *[1.0] * (LATEST - 1)), TrackRecord({"model_based": LinearGain([[0.0, 0.0]])})
    again.load_state_dict(first.state_dict())
    assert kept(flown(1.0, found=again)) == kept(flown(1.0, found=first)) == ([3.0], [1.0] * LATEST)


def test_the_alarm_asks_the_latest_episodes_alone():
    """Three old episodes cost e² times what the twin says, the latest one 35 % more."""
    found = twinning(arm="model_based", exploration=ExplorationConfig(episodes=0))
    found.interact()
    differences = found.track_record.differences(found.virtual)
    for earlier, alarm in ((0, 1.0), (3, 0.0)):
        paired = differences._replace(
            policies=differences.policies * 4,
            values=[2.0] * 3 + [0.3],
            exploration=[0.0] * 4,
            flown=[one._replace(cost=cost) for cost in range(4) for one in differences.flown],
            earlier=earlier,
        )
        found.track_record.differences = lambda virtual, paired=paired: paired
        assert found.examination.examine()["alarm"] == alarm
    found.track_record.differences = lambda virtual: paired._replace(earlier=4)
    assert not found.examination.examine().keys()  # state feedback flew all of the latest


def dear_beyond(found, first, factor):
    """Let the real system cost the factor times as much where the gain is not the first one; returns the flights."""
    fly, flights = found.flights.fly, []

    def flown(policy, *, strength, whole):
        flight = fly(policy, strength=strength, whole=whole)
        dear = (policy.gain - first).abs().max().item() > 0.05
        flight.transitions["next", "reward"] *= factor if dear else 1.0
        flights.append(dear)
        return flight

    found.flights.fly = flown
    return flights


def test_a_plan_that_a_real_episode_refuted_does_not_come_back():
    """The twin is exact in all but the cost of its own plans, which is ten times as high."""
    plant = LinearQuadratic(horizon=2.0)
    lbfgs = PlannerConfig(iterations=10, descent=DescentConfig(optimiser="lbfgs", rate=1.0))
    found = twinning(
        plant,
        closure=LinearClosure(plant.true_closure),
        arm="model_based",
        corrected_plans=True,
        planner=lbfgs,
        exploration=ExplorationConfig(episodes=0),
    )
    first = found.policies["model_based"].gain.detach().clone()
    flights = dear_beyond(found, first, 10.0)
    reports = [found.episode() for _ in range(LATEST + 3)]
    assert flights == [False, True] + [False] * (LATEST + 1)
    assert all(report["alarm"].item() for report in reports[1:])
