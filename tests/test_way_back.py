"""Plans from earlier weights where gradients explode under the present ones."""

import math

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic

from rt_torchrl import DigitalTwin, PlannerConfig
from rt_torchrl.optimisers.descent import DescentConfig, stuck
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.plan import Planning, ShortHorizon, ShortHorizonConfig, WholeEpisodes
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.twinning.findings import findings
from rt_torchrl.twinning.judgement import Judgement
from rt_torchrl.twinning.way_back import WayBack

EPISODES = Scenario(torch.zeros(1, 2).double(), torch.zeros(1, 20, 1).double())
JUDGEMENT = Judgement(lambda one, other: one > other, track_record=None)
EXPLODING = findings(J_a_plan_before=1.0, J_a_plan=1.0, policy_gradient=1e30, plan_accepted=1.0)
SOUND = findings(J_a_plan_before=1.0, J_a_plan=1.0, policy_gradient=1.0, plan_accepted=1.0)


class Chaotic(DigitalTwin):
    """Episodes like bowls; where the second gain is above 6 the closed loop is chaotic, and costs ripple by 1e-4."""

    def episode_costs(self, policy, initial_state, exogenous):
        gain = policy.gain.flatten()
        bowl = 1.0 + 0.01 * (gain - torch.tensor([2.0, 3.0]).double()).square().sum()
        phases = torch.linspace(0.0, 3.0, 4).double()
        ripple = 1e-4 * torch.sin(1e13 * gain.sum() + phases) if gain[1] > 6.0 else 0.0 * phases
        return bowl + ripple


class Virtual(VirtualEpisodes):
    """Virtual episodes on this twin, which judge by the mean cost."""

    def __init__(self, twin):
        self.twin = twin

    def price(self, policy, episodes):
        return self.twin.episode_costs(policy, *episodes).mean().detach()

    def tail(self, policy, episodes):
        return 0.0

    extremes, constraints = 0, None

    def with_extremes(self, episodes):
        return episodes


def weights(value):
    return LinearGain([[value, value]]).state_dict()


class TwoValleys(DigitalTwin):
    """Two bowls over the second gain: one at 3, and a poor one at -3."""

    def episode_costs(self, policy, initial_state, exogenous):
        gain = policy.gain.flatten()
        valleys = [offset + 0.1 * (gain[1] - at).square() for offset, at in ((1.0, 3.0), (1.5, -3.0))]
        return torch.minimum(*valleys) * torch.ones(4).double()


def planning(limit, anew=0, twin=Chaotic):
    plant, policy = LinearQuadratic(), LinearGain([[-1.0, -1.0]])
    twin = twin(plant, plant.closure)
    descent = DescentConfig(optimiser="lbfgs", rate=1.0)
    config = PlannerConfig(iterations=40, anew=anew, episode_gradient_limit=limit, descent=descent)
    return Planning(WholeEpisodes(twin, policy, config), Virtual(twin), config)


@pytest.mark.parametrize("anew", [0, 2])
def test_the_second_plan_leaves_a_poor_minimum_from_the_first_weights(anew):
    """The first plan ended in the poor one, because another episode had been met."""
    steps = planning(10.0, anew, TwoValleys)
    policy = steps.planner.policy
    policy.load_state_dict(weights(1.0))
    steps.plan(1, EPISODES, EPISODES, JUDGEMENT)
    policy.load_state_dict(weights(-2.9))
    found = steps.plan(2, EPISODES, EPISODES, JUDGEMENT)
    assert found["led_back"] == float(anew == 2)
    expected = 1.0 if anew else 1.5
    assert steps.virtual.price(policy, EPISODES).item() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("limit", "led_back"), [(10.0, 1.0), (math.inf, 0.0)])
def test_a_plan_that_is_stuck_is_made_from_earlier_weights_too(limit, led_back):
    steps = planning(limit)
    policy = steps.planner.policy
    assert steps.plan(1, EPISODES, EPISODES, JUDGEMENT)["led_back"] == 0.0
    assert steps.virtual.price(policy, EPISODES) == pytest.approx(1.0, abs=1e-6)
    policy.load_state_dict(weights(8.0))
    found = steps.plan(2, EPISODES, EPISODES, JUDGEMENT)
    assert found["led_back"] == led_back
    assert (steps.virtual.price(policy, EPISODES).item() < 1.001) is bool(led_back)


def test_earlier_weights_that_lead_to_nothing_better_leave_the_policy_as_it_is():
    steps = planning(10.0)
    policy = steps.planner.policy
    steps.way_back.load_state_dict({"sound": [weights(50.0)], "plans": 1, "stuck": 0})
    policy.load_state_dict(weights(8.0))
    found = steps.plan(1, EPISODES, EPISODES, JUDGEMENT)
    assert found["led_back"] == 0.0
    torch.testing.assert_close(policy.state_dict(), weights(8.0), rtol=0.0, atol=1e-3)


def test_the_first_weights_and_the_last_sound_ones_are_tried_in_the_episodes_1_2_4_and_8():
    way, policy = WayBack(10.0), LinearGain([[0.0, 0.0]])
    for value in (1.0, 2.0, 3.0):
        assert way.after(SOUND, weights(value), policy) == []
    tried = [[each["gain"][0, 0].item() for each in way.after(EXPLODING, weights(4.0), policy)] for _ in range(9)]
    assert tried == [[3.0, 1.0] if episode in (1, 2, 4, 8) else [] for episode in range(1, 10)]
    assert way.after(SOUND, weights(5.0), policy) == []
    again = WayBack(10.0)
    again.load_state_dict(way.state_dict())
    assert [each["gain"][0, 0].item() for each in again.after(EXPLODING, weights(6.0), policy)] == [5.0, 1.0]


@pytest.mark.parametrize("limit", [10.0, math.inf])
def test_the_first_plans_are_made_from_the_first_weights_too(limit):
    way, policy = WayBack(limit, anew=3), LinearGain([[0.0, 0.0]])
    tried = [[each["gain"][0, 0].item() for each in way.after(SOUND, weights(k), policy)] for k in (1.0, 2.0, 3.0, 4.0)]
    assert tried == [[], [1.0], [1.0], []]


def test_the_copy_that_plans_over_a_short_horizon_goes_on():
    """Its plans may gain nothing for a while."""
    short = ShortHorizonConfig(window=5)
    plant, config = LinearQuadratic(), PlannerConfig(iterations=1, episode_gradient_limit=1.0, short_horizon=short)
    twin = Chaotic(plant, plant.closure)
    planner = ShortHorizon(twin, LinearGain([[-1.0, -1.0]]), config, generator=torch.Generator())
    way = Planning(planner, Virtual(twin), config).way_back
    assert way.after(SOUND, weights(1.0), planner.policy) == []
    assert way.after(EXPLODING, weights(2.0), planner.policy) == []


@pytest.mark.parametrize(
    "options",
    [
        {"anew": -1},
        {"anew": 2, "method": "receding_horizon"},
        {"anew": 2, "short_horizon": ShortHorizonConfig(window=5)},
    ],
)
def test_a_number_of_plans_that_makes_no_sense_is_refused(options):
    with pytest.raises(ValueError, match=f"anew={options['anew']} of the planning must not be negative, and at most 1"):
        PlannerConfig(**options)


def test_a_plan_that_could_not_begin_is_stuck():
    way, policy = WayBack(10.0), LinearGain([[0.0, 0.0]])
    way.after(SOUND, weights(1.0), policy)
    assert len(way.after(findings("no plan: the gradient is not finite", plan_accepted=0.0), weights(2.0), policy)) == 1


@pytest.mark.parametrize(
    ("before", "after", "promised", "expected"),
    [
        (2.0, 2.0, 21.0, True),
        (2.0, 2.0, 19.0, False),  # the gradient is believable
        (2.0, 1.9, 21.0, False),  # the plan gained something
        (2.0, 1.9999, 21.0, True),
        (-2.0, -2.0, 21.0, True),
    ],
)
def test_a_descent_is_stuck_where_it_gains_nothing_of_what_its_gradient_promises(before, after, promised, expected):
    assert stuck(before, after, promised / 5.0, [torch.tensor([3.0, 4.0])], 10.0) is expected
