"""Extreme initial states, from which plans and imitations must not fail."""

import math

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from test_first_controller import twinning

from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.optimisers.descent import Descended
from rt_torchrl.steps.belief import TrackRecord
from rt_torchrl.steps.inputs import ExtremeStarts, VirtualEpisodes, astray
from rt_torchrl.steps.plan import PlannerConfig, Planning
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.judgement import Judgement

CPU = torch.device("cpu")


def test_they_are_beyond_nearly_all_random_starts():
    plant = LinearQuadratic(horizon=1.0)
    found = ExtremeStarts(plant, 1000, CPU).states
    drawn = plant.draw_initial_state(5000, torch.Generator().manual_seed(0))
    assert found.shape == (4, 2)
    for column in range(2):
        beyond = (drawn[:, column] > found[:, column].max()) | (drawn[:, column] < found[:, column].min())
        assert beyond.double().mean() < 0.01


@pytest.mark.parametrize(("plant", "count"), [(LinearQuadratic(horizon=1.0), 0), (FlappingWing(), 1000)])
def test_without_random_starts_there_are_none(plant, count):
    """Each hop and flight of the drone begins at rest in the origin."""
    assert not ExtremeStarts(plant, count, CPU)


def test_they_fly_under_the_inputs_of_other_episodes():
    found = ExtremeStarts(LinearQuadratic(horizon=1.0), 1000, CPU)
    inputs = torch.arange(3.0).double().reshape(3, 1, 1)
    episodes = Scenario(torch.zeros(3, 2).double(), inputs)
    assert found.under(episodes).exogenous.flatten().tolist() == [0.0, 1.0, 2.0, 0.0]
    beside = found.beside(episodes)
    assert beside.exogenous.flatten().tolist() == [0.0, 1.0, 2.0, 0.0, 1.0, 2.0, 0.0]
    assert torch.equal(beside.initial_state[3:], found.states)


@pytest.mark.parametrize(
    ("tail", "than", "cost", "fails"),
    [
        (230.0, 15.0, 1.9, True),  # saves 5 % elsewhere, and fails from there
        (16.0, 15.0, 1.9, False),
        (225.0, 220.0, 2.0, True),  # the other one fails, too, and is not to be made worse
        (230.0, 60.0, 0.1, False),  # one episode in a hundred is not worth what it saves elsewhere
        (45.0, 15.0, 6.0, False),  # it costs three times as much everywhere
        (80.0, 15.0, 6.0, True),
        (math.inf, 15.0, 1.9, True),
        (math.inf, 15.0, math.inf, False),
        (math.inf, math.inf, 1.9, False),
    ],
)
def test_who_fails(tail, than, cost, fails):
    assert astray(tail, than, cost=cost, usual=2.0) == fails


class Trapped(VirtualEpisodes):
    """Virtual episodes in which a gain costs itself, and a gain below 1 costs 1000 from the extreme starts."""

    def __init__(self, plant, count=1000):
        self.twin, self.extremes = DigitalTwin(plant, plant.closure), ExtremeStarts(plant, count, CPU)

    def cost(self, policy, episodes):
        gain = policy.gain.detach().sum()
        far = (episodes.initial_state.abs() > 3.0).any()
        return torch.where(far & (gain < 1.0), 1000.0, gain)


class Greedy:
    """A planner that goes to a small gain, or to a greater one where it sees extreme starts."""

    def __init__(self, policy, wary):
        self.policy, self.wary = policy, wary

    def plan(self, episodes):
        with torch.no_grad():
            self.policy.gain.fill_(0.75 if self.wary and len(episodes.initial_state) > 1 else 0.25)
        return Descended(4.0, 0.5, 0.0, 1)

    def refuse(self):
        pass

    restart = load_state_dict = state_dict = refuse


@pytest.mark.parametrize(("wary", "kept"), [(True, [[0.75, 0.75]]), (False, [[1.0, 1.0]])])
def test_a_plan_that_fails_from_extreme_starts_is_made_again_with_them(wary, kept):
    policy = LinearGain([[1.0, 1.0]])
    virtual = Trapped(LinearQuadratic(horizon=2.0))
    planning = Planning(Greedy(policy, wary), virtual, PlannerConfig())
    judgement = Judgement(lambda a, b: a > b, TrackRecord({}))
    episodes = Scenario(torch.zeros(1, 2).double(), torch.zeros(1, 20, 1).double())
    report = planning.plan(1, episodes, episodes, judgement)
    assert policy.gain.tolist() == kept
    assert report["astray"] == 1.0 and report["plan_accepted"] == float(wary)


@pytest.mark.parametrize(("count", "kept"), [(1000, [[1.0, 1.0]]), (0, [[0.25, 0.25]])])
def test_a_plan_from_other_weights_that_fails_from_extreme_starts_is_refused(count, kept):
    policy = LinearGain([[1.0, 1.0]])
    virtual = Trapped(LinearQuadratic(horizon=2.0), count)
    planning = Planning(Greedy(policy, wary=False), virtual, PlannerConfig())
    planning.others.append({"gain": torch.full((1, 2), 4.0).double()})
    # The plan from the present weights is refused, so that only the one from the others could be kept.
    judgement = Judgement(lambda a, b: True, TrackRecord({}))
    episodes = Scenario(torch.zeros(1, 2).double(), torch.zeros(1, 20, 1).double())
    planning.plan(1, episodes, episodes, judgement)
    assert policy.gain.tolist() == kept and not planning.others


@pytest.mark.parametrize(
    ("own", "of_the_controller", "fails"),
    [
        (1e3, 0.0, True),
        (0.0, 0.0, False),
        (1900.0, 1000.0, False),  # the controller itself fails there, and its imitation not twice as much
        (2100.0, 1000.0, True),
    ],
)
def test_an_imitation_that_fails_from_extreme_starts_imitates_there_too(own, of_the_controller, fails):
    found, drawn = twinning(), []
    imitate, teacher = found.cloning.distillation.imitate, found.first.teacher

    def seen(live, idle, *, seen, draw):
        drawn.append(len(draw().initial_state))
        return imitate(live, idle, seen=seen, draw=draw)

    found.cloning.distillation.imitate = seen
    found.virtual.tail = lambda policy, episodes: of_the_controller if policy is teacher else own
    found.start()
    assert drawn == 2 * ([4, 8] if fails else [4])  # both policies


def test_a_negative_number_is_refused():
    with pytest.raises(ValueError, match="extremes=-1"):
        PlannerConfig(extremes=-1)
