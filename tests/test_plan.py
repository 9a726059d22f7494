"""Step 5: plans from several starts, judged on other episodes."""

import math

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from seeds_and_numbers import seeded
from test_algorithm import twinning, weights
from test_belief import EPISODES, REFUTED, Hasty, belief_of, gains, said
from test_first_controller import begun
from torch.nn.utils import parameters_to_vector

from rt_torchrl import Descended, DescentConfig, DigitalTwin, SaturatedAffine, Scenario
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.plants.signal import bounds
from rt_torchrl.steps import plan
from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import AssimilationConfig, ExogenousConfig, PlannerConfig
from rt_torchrl.steps.inputs import VirtualEpisodes, extreme_states
from rt_torchrl.steps.plan import MultiStart, WholeEpisodes

CPU = torch.device("cpu")


class Still(WholeEpisodes):
    """A planner whose descents end where they begin; ``begun`` are the weights of each."""

    def __init__(self, policy, virtual):
        super().__init__(virtual.twin, policy, PlannerConfig())
        self.virtual, self.begun = virtual, []

    def plan(self, episodes):
        cost = self.virtual.cost(self.policy, episodes)
        self.begun.append(said(self.policy))
        return Descended(cost, cost, 0.0, 1)


def multi_start(policy, belief, drawn=lambda generator: LinearGain([[4.0, 0.0]]), **options):
    belief.virtual.generator = torch.Generator().manual_seed(5)
    return MultiStart(Still(policy, belief.virtual), belief, PlannerConfig(**options), (1, 1), drawn)


def planned_in(planning, episodes=range(1, 17)):
    """The episodes in which plans had several starts."""
    found = []
    for episode in episodes:
        planning.planner.begun.clear()
        planning.plan(episode, EPISODES, EPISODES)
        found += [episode] if len(planning.planner.begun) > 1 else []
    return found


def test_other_weights_are_tried_in_the_episodes_1_2_and_4():
    assert planned_in(multi_start(LinearGain([[3.0, 0.0]]), belief_of())) == [1, 2, 4]
    assert planned_in(multi_start(LinearGain([[3.0, 0.0]]), belief_of(), starts=0)) == []


def test_a_stalled_descent_tries_other_weights_in_its_first_second_and_fourth_episode():
    planning = multi_start(LinearGain([[3.0, 0.0]]), belief_of())
    plan = planning.planner.plan
    planning.planner.plan = lambda episodes: plan(episodes)._replace(gradient=1e30)
    assert planned_in(planning, range(33, 43)) == [33, 34, 36, 40]
    planning.planner.plan = plan
    planning.plan(43, EPISODES, EPISODES)
    planning.planner.plan = lambda episodes: plan(episodes)._replace(gradient=1e30)
    assert planned_in(planning, range(44, 46)) == [44, 45]


@pytest.mark.parametrize(("random", "kept"), [(2.0, 2.0), (4.0, 3.0)])
def test_the_best_plan_stays(random, kept):
    policy = LinearGain([[3.0, 0.0]])
    planning = multi_start(policy, belief_of(), lambda generator: LinearGain([[random, 0.0]]))
    report = planning.plan(1, EPISODES, EPISODES)
    assert said(policy) == kept and report["start"] == float(kept == 2.0)


@pytest.mark.parametrize(("corrects", "kept"), [(False, 2.0), (True, 3.0)])
def test_a_plan_that_flights_refute_is_refused_and_what_has_flown_comes_back(corrects, kept):
    """The twin says 2 of a policy that cost e² times as much, and 3 of an earlier one, which cost it."""
    policy, belief = LinearGain([[3.0, 0.0]]), belief_of(*REFUTED, corrects=corrects)
    multi_start(policy, belief, lambda generator: LinearGain([[2.0, 0.0]])).plan(1, EPISODES, EPISODES)
    assert said(policy) == kept
    policy = LinearGain([[2.0, 0.0]])
    report = multi_start(policy, belief_of(*REFUTED, corrects=corrects)).plan(3, EPISODES, EPISODES)
    assert said(policy) == kept and report.get("start") == (2.0 if corrects else None)


def test_the_cheapest_of_all_random_policies_is_a_start(monkeypatch):
    policy = LinearGain([[3.0, 0.0]])
    drawn = lambda generator: LinearGain([[4.0 + torch.rand((), generator=generator).item(), 0.0]])  # noqa: E731
    planning = multi_start(policy, belief_of(), drawn, starts=8)
    seen, cost = [], planning.virtual.cost
    monkeypatch.setattr(planning.virtual, "cost", lambda one, on: seen.append(said(one)) or cost(one, on))
    planning.plan(2, EPISODES, EPISODES)
    random = [gain for gain in seen if gain >= 4.0]
    assert len(set(random)) == 8 and planning.planner.begun == [3.0, min(random)]


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
def test_starts_that_find_nothing_change_no_training(optimiser, monkeypatch):
    """Nor do they change what the next plan depends on: random numbers, and moments of Adam."""
    monkeypatch.setattr(MultiStart, "_random", lambda *arguments: gains(-50.0))
    descent = DescentConfig(optimiser=optimiser, rate=0.01 if optimiser == "adam" else 1.0)
    planners = (PlannerConfig(iterations=5, descent=descent, starts=count) for count in (0, 4))
    still = AssimilationConfig(iterations=0)  # a plan on another twin may gain nothing, and then has several starts
    found = [twinning(arm="model_based", planner=planner, assimilation=still) for planner in planners]
    for training in found:
        reports = [training.episode() for _ in range(5)]
    assert reports[3]["start"] == 0.0
    one, two = (weights(training.policies["model_based"]) for training in found)
    assert torch.equal(one, two) and torch.equal(*(training.generator.get_state() for training in found))


class Chaotic(DigitalTwin):
    """Episodes like bowls; where the second gain is above 6 the closed loop is chaotic, and costs ripple by 1e-4."""

    def episode_costs(self, policy, initial_state, exogenous, deviation=None):
        gain = policy.gain.flatten()
        bowl = 1.0 + 0.01 * (gain - torch.tensor([2.0, 3.0]).double()).square().sum()
        phases = torch.linspace(0.0, 3.0, 4).double()
        ripple = 1e-4 * torch.sin(1e13 * gain.sum() + phases) if gain[1] > 6.0 else 0.0 * phases
        return bowl + ripple


@pytest.mark.parametrize(("limit", "led_back"), [(10.0, True), (math.inf, False)])
def test_a_plan_that_is_stuck_is_made_from_other_weights_too(limit, led_back, monkeypatch):
    plant, policy = LinearQuadratic(), LinearGain([[8.0, 8.0]])
    twin = Chaotic(plant, plant.closure)
    monkeypatch.setattr(plan, "GRADIENT_LIMIT", limit)
    config = PlannerConfig(iterations=40, descent=DescentConfig(optimiser="lbfgs", rate=1.0))
    virtual = VirtualEpisodes(twin, ExogenousConfig(), 1, generator=torch.Generator().manual_seed(0))
    belief = Belief({"model_based": policy}, virtual)
    planner, drawn = WholeEpisodes(twin, policy, config), lambda _: LinearGain([[-1.0, -1.0]])
    planning = MultiStart(planner, belief, config, (1, 1), drawn)
    report = planning.plan(3, EPISODES, EPISODES)
    assert (virtual.cost(policy, EPISODES) < 1.001) is led_back and ("start" in report) is led_back


def test_extreme_starts_are_beyond_nearly_all_random_ones():
    plant = LinearQuadratic(horizon=1.0)
    found = extreme_states(plant, 1000, CPU)
    drawn = plant.draw_initial_state(5000, torch.Generator().manual_seed(0))
    assert found.shape == (4, 2)
    for column in range(2):
        beyond = (drawn[:, column] > found[:, column].max()) | (drawn[:, column] < found[:, column].min())
        assert beyond.double().mean() < 0.01
    assert not len(extreme_states(plant, 0, CPU))
    assert not len(extreme_states(FlappingWing(), 1000, CPU))  # its flights begin at rest in the origin


class Trapped(VirtualEpisodes):
    """Virtual episodes in which a gain costs itself, and a gain below 1 costs 1000 from the extreme starts."""

    def __init__(self, extremes=1000):
        plant = LinearQuadratic(horizon=2.0)
        twin = DigitalTwin(plant, plant.closure)
        super().__init__(twin, ExogenousConfig(), 1, extremes=extremes, generator=torch.Generator().manual_seed(0))

    def cost(self, policy, episodes):
        gain = policy.gain.detach().sum().item()
        return 1000.0 if (episodes.initial_state.abs() > 3.0).any() and gain < 1.0 else gain


class Greedy(Hasty):
    """A planner that goes to a small gain, or to a greater one where it sees extreme starts."""

    def __init__(self, policy, wary):
        super().__init__(policy)
        self.wary = wary

    def plan(self, episodes):
        with torch.no_grad():
            self.policy.gain.fill_(0.75 if self.wary and len(episodes.initial_state) > 1 else 0.25)
        return Descended(4.0, 0.5, 0.0, 1)


@pytest.mark.parametrize(
    ("wary", "extremes", "kept"), [(True, 1000, 0.75), (False, 1000, 1.0), (False, 0, 0.25), (True, 0, 0.25)]
)
def test_a_plan_that_fails_from_extreme_starts_is_made_again_with_them(wary, extremes, kept):
    policy = LinearGain([[1.0, 1.0]])
    planning = MultiStart(Greedy(policy, wary), Belief({}, Trapped(extremes)), PlannerConfig(), (1, 1))
    report = planning.plan(1, EPISODES, EPISODES)
    assert policy.gain.tolist() == [[kept, kept]] and report["plan_accepted"] == float(kept != 1.0)


def test_episodes_from_extreme_starts_have_the_inputs_of_others_and_count_where_they_fail():
    virtual, policy = Trapped(), LinearGain([[0.5, 0.0]])
    inputs = torch.arange(3.0).double().reshape(3, 1, 1)
    beside = virtual.with_extremes(Scenario(torch.zeros(3, 2).double(), inputs))
    assert beside.exogenous.flatten().tolist() == [0.0, 1.0, 2.0, 0.0, 1.0, 2.0, 0.0]
    assert torch.equal(beside.initial_state[3:], virtual.extremes)
    assert virtual.judge(policy, EPISODES) == (0.5 + 0.01 * (1000.0 - 5.0), 0.5)


@pytest.mark.parametrize(("dear", "imitates_there"), [(False, False), (True, True)])
def test_an_imitation_that_fails_from_extreme_starts_imitates_there_too(dear, imitates_there, monkeypatch):
    found, drawn = begun(), []
    imitate, judge, teacher = found.steps["switch"].imitation.imitate, found.virtual.judge, found.first.teacher

    def seen(live, idle, *, seen, draw):
        drawn.append(len(draw().initial_state))
        return imitate(live, idle, seen=seen, draw=draw)

    def judged(policy, episodes):
        cost, on_twin = judge(policy, episodes)
        return (cost if policy is teacher or not dear else 100.0 * cost), on_twin

    monkeypatch.setattr(found.steps["switch"].imitation, "imitate", seen)
    monkeypatch.setattr(found.virtual, "judge", judged)
    found.start()
    assert drawn == 2 * ([4, 8] if imitates_there else [4])  # both policies


def test_an_imitation_of_a_jump_keeps_weights_with_gradients():
    imitation, plant = begun().steps["switch"].imitation, LinearQuadratic()
    pupil = SaturatedAffine(2, plant.actions, generator=seeded(0))
    observations = torch.randn(500, 2, generator=seeded(1), dtype=torch.float64)
    low, high = bounds(plant.actions)
    error = imitation._match(pupil, [(observations, torch.where(observations[:, :1] > 0.0, high, low))])
    assert error < 0.1 and parameters_to_vector(pupil.parameters()).abs().max() < 1e3


def test_a_random_start_has_drawn_weights_where_layers_share_them():
    class Twice(torch.nn.Module):
        def __init__(self, gain):
            super().__init__()
            self.one = self.other = LinearGain(gain)

        def forward(self, observation):
            return 0.5 * (self.one(observation) + self.other(observation))

    planning = multi_start(Twice([[3.0, 2.0]]), belief_of(), lambda generator: Twice([[1.0, 0.5]]))
    planning.virtual.cost = lambda policy, episodes: policy.one.gain.sum().item()
    assert {tuple(weight.flatten().tolist()) for weight in planning._random(1, EPISODES).values()} == {(1.0, 0.5)}
