"""Step 5: plans from several starts and with bounds on states, judged on other episodes."""

import copy
import dataclasses
import math

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from small_runs import SMALL, small_run
from test_algorithm import twinning, weights
from test_belief import EPISODES, REFUTED, Content, belief_of, gains, said
from test_first_controller import begun

from rt_torchrl import RefereeConfig
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.optimisers.descent import Descended, DescentConfig, stuck
from rt_torchrl.plants.signal import StateBounds
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.steps import plan
from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import AssimilationConfig, ConstraintsConfig, ExogenousConfig, PlannerConfig
from rt_torchrl.steps.constraints import Constraints
from rt_torchrl.steps.inputs import VirtualEpisodes, extreme_states
from rt_torchrl.steps.plan import MultiStart, WholeEpisodes
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

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
    return MultiStart(Still(policy, belief.virtual), belief, PlannerConfig(**options), drawn)


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
def test_a_plan_that_flights_refute_is_refused(corrects, kept):
    policy = LinearGain([[3.0, 0.0]])
    planning = multi_start(policy, belief_of(*REFUTED, corrects=corrects), lambda generator: LinearGain([[2.0, 0.0]]))
    planning.plan(1, EPISODES, EPISODES)
    assert said(policy) == kept


def test_what_has_flown_comes_back_where_the_present_weights_are_refuted():
    """The twin says 2 of the present policy, which cost e² times as much, and 3 of an earlier one, which cost it."""
    for corrects, kept in ((True, 3.0), (False, 2.0)):
        policy = LinearGain([[2.0, 0.0]])
        report = multi_start(policy, belief_of(*REFUTED, corrects=corrects)).plan(3, EPISODES, EPISODES)
        assert said(policy) == kept and ("start" in report) == corrects
        assert not corrects or report["start"] == 3.0


def test_weights_before_an_imitation_are_a_start():
    policy = LinearGain([[2.5, 0.0]])
    planning = multi_start(policy, belief_of())
    planning.remember()
    policy.load_state_dict(gains(3.0))
    planning.plan(3, EPISODES, EPISODES)
    assert said(policy) == 3.0
    again = multi_start(policy, belief_of())
    again.load_state_dict(copy.deepcopy(planning.state_dict()))
    report = again.plan(2, EPISODES, EPISODES)
    assert said(policy) == 2.5 and report["start"] == 2.0


def test_the_cheapest_of_all_random_policies_is_a_start(monkeypatch):
    policy = LinearGain([[3.0, 0.0]])
    planning = multi_start(
        policy,
        belief_of(),
        lambda generator: LinearGain([[4.0 + torch.rand((), generator=generator).item(), 0.0]]),
        starts=8,
    )
    seen, price = [], planning.virtual.price
    monkeypatch.setattr(planning.virtual, "price", lambda one, on: seen.append(said(one)) or price(one, on))
    planning.plan(2, EPISODES, EPISODES)
    random = [gain for gain in seen if gain >= 4.0]
    assert len(set(random)) == 8 and planning.planner.begun == [3.0, min(random)]


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
def test_starts_that_find_nothing_change_no_training(optimiser, monkeypatch):
    """Nor do they change what the next plan depends on: random numbers, and moments of Adam."""
    monkeypatch.setattr(MultiStart, "_others", lambda *arguments: iter([(1, gains(-50.0))]))
    descent = DescentConfig(optimiser=optimiser, rate=0.01 if optimiser == "adam" else 1.0)
    planners = (PlannerConfig(iterations=5, descent=descent, starts=count) for count in (0, 4))
    still = AssimilationConfig(iterations=0)  # a plan on another twin may gain nothing, and then has several starts
    found = [twinning(arm="model_based", planner=planner, assimilation=still) for planner in planners]
    for training in found:
        reports = [training.episode() for _ in range(5)]
    assert reports[3]["start"] == 0.0
    one, two = (weights(training.policies["model_based"]) for training in found)
    assert torch.equal(one, two) and torch.equal(*(training.generator.get_state() for training in found))


def test_an_interrupt_leaves_the_policy_its_weights(monkeypatch):
    found = twinning(arm="model_based")
    found.episode()
    before = weights(found.policies["model_based"])
    price, asked = found.virtual.price, []

    def interrupted(policy, episodes):
        asked.append(policy)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return price(policy, episodes)

    monkeypatch.setattr(found.virtual, "price", interrupted)
    with pytest.raises(KeyboardInterrupt):
        found.episode()
    assert torch.equal(weights(found.policies["model_based"]), before)


class Chaotic(DigitalTwin):
    """Episodes like bowls; where the second gain is above 6 the closed loop is chaotic, and costs ripple by 1e-4."""

    def episode_costs(self, policy, initial_state, exogenous):
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
    planning = MultiStart(WholeEpisodes(twin, policy, config), belief, config, lambda _: LinearGain([[-1.0, -1.0]]))
    report = planning.plan(3, EPISODES, EPISODES)
    assert (virtual.price(policy, EPISODES) < 1.001) is led_back and ("start" in report) is led_back


@pytest.mark.parametrize(
    ("before", "after", "promised", "expected"),
    [(1.0, 1.0, 1e3, True), (1.0, 0.5, 1e3, False), (1.0, 1.0, 1.0, False), (-1.0, -1.0, 1e3, True)],
)
def test_a_descent_is_stuck_where_it_gains_nothing_of_what_its_gradient_promises(before, after, promised, expected):
    weights = [torch.tensor([3.0, 4.0])]
    assert stuck(before, after, promised / 5.0, weights, limit=10.0) is expected


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


class Greedy(Content):
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
    planning = MultiStart(Greedy(policy, wary), Belief({}, Trapped(extremes)), PlannerConfig())
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
        cost, price = judge(policy, episodes)
        return (cost if policy is teacher or not dear else 100.0 * cost), price

    monkeypatch.setattr(found.steps["switch"].imitation, "imitate", seen)
    monkeypatch.setattr(found.virtual, "judge", judged)
    found.start()
    assert drawn == 2 * ([4, 8] if imitates_there else [4])  # both policies


def test_the_papers_rule_keeps_plans_by_the_twin_and_every_update():
    found = begun(referee=RefereeConfig(rule="decision_tree"))
    update = found.learner.update

    def ruined():
        report = update()
        found.policies["model_free"].gain.data.fill_(-0.6)
        return report

    found.learner.update = ruined
    assert "update_accepted" not in found.episode()
    assert found.policies["model_free"].gain.detach().unique().tolist() == [-0.6]


# Bounds on states: their price by hand, its gradient, plans that keep them, and what results say of them.


POSITION = {"position": (-1.0, 3.0)}


def flown(*positions):
    states = torch.tensor([[[x, 0.0] for x in (0.0, *positions)]], dtype=torch.float64)
    rest = torch.zeros(1, len(positions), 1, dtype=torch.float64)
    return Trajectory(states, rest, rest)


def test_how_often_and_how_far_a_state_is_beyond_its_bounds():
    found = StateBounds(LinearQuadratic().readings, POSITION).merit(flown(-1.5, 0.0, 5.0, 3.0).states)
    assert found["position outside [%]"].tolist() == [50.0]
    assert found["position beyond [m]"].tolist() == [2.0]
    one_sided = StateBounds(LinearQuadratic().readings, {"velocity": (-math.inf, 2.0)})
    assert one_sided.shares(torch.tensor([0.0, 3.0]).double()).tolist() == [0.5]
    with pytest.raises(ValueError, match=r"bounded states speed do not exist; the plant has position, velocity\."):
        StateBounds(LinearQuadratic().readings, {"speed": (0.0, 1.0)})


def test_the_price_is_that_of_the_formula():
    constraints = Constraints(LinearQuadratic(), ConstraintsConfig(states=POSITION, weight=8.0))
    positions, cost = (-1.5, 0.0, 5.0, 3.0), torch.tensor([3.0], dtype=torch.float64)
    first = constraints.priced(cost, flown(*positions)).item()
    # Excess of 0.5 and 2 metres of a width of 4, in two of four intervals.
    assert first == pytest.approx(3.0 + 3.0 * 0.5 * 8.0 * (0.125**2 + 0.5**2) / 4.0)
    constraints.update(flown(*positions))
    again = constraints.priced(torch.tensor([5.0]).double(), flown(*positions)).item()
    mu = 8.0 * (0.125 + 0.5) / 2.0
    beyond = [(-1.0 - x) / 4.0 for x in positions] + [(x - 3.0) / 4.0 for x in positions]
    price = sum(max(0.0, mu + 8.0 * g) ** 2 for g in beyond) / 4.0 / 16.0
    assert again == pytest.approx(5.0 + 3.0 * price)  # the reference stays 3
    assert constraints.report()["excess/position"] == pytest.approx((0.125 + 0.5) / 4.0)


def planner_of(weight=100.0):
    plant = LinearQuadratic(horizon=4.0)
    twin, policy = DigitalTwin(plant, plant.closure), LinearGain([[0.1, 0.1]])
    config = PlannerConfig(
        iterations=40,
        descent=DescentConfig(optimiser="lbfgs", rate=1.0),
        constraints=ConstraintsConfig(states={"velocity": (-0.6, 0.6)}, weight=weight),
    )
    return WholeEpisodes(twin, policy, config)


def from_rest_at(*positions):
    start = torch.tensor([[x, 0.0] for x in positions], dtype=torch.float64)
    return Scenario(start, torch.zeros(len(positions), 40, 1, dtype=torch.float64))


def judged(planner):
    """Step 5 with this planner."""
    virtual = VirtualEpisodes(
        planner.twin,
        ExogenousConfig(),
        1,
        constraints=planner.constraints,
        generator=torch.Generator().manual_seed(0),
    )
    return MultiStart(planner, Belief({}, virtual), dataclasses.replace(planner.config, starts=0))


def test_plans_come_to_keep_bounds_that_the_cheapest_plan_leaves():
    episodes = from_rest_at(-1.2, -0.6, 0.8, 1.2)

    def fastest(planner):
        return planner.twin.control(planner.policy, *episodes).states[..., 1].abs().max().item()

    free, softly, bound = planner_of(1e-9), planner_of(), planner_of()
    free.plan(episodes)
    softly.plan(episodes)  # once, before a multiplier has grown
    steps = judged(bound)
    for episode in range(1, 9):
        steps.plan(episode, episodes, episodes)
    assert fastest(free) > 0.75
    assert 0.6 < fastest(softly) < fastest(free)
    # A thousandth of the width beyond.
    assert fastest(bound) < 0.6012
    assert bound.twin.cost(bound.policy, *episodes) > free.twin.cost(free.policy, *episodes)
    other = planner_of()
    other.load_state_dict(bound.state_dict())
    assert other.constraints.multipliers == bound.constraints.multipliers and other.constraints.reference > 0.0


def test_a_plan_and_the_policy_that_it_would_replace_have_the_same_price():
    """A plan is not dearer than the policy it starts from, so that each stays, and the multiplier settles."""
    planner, episodes = planner_of(), from_rest_at(-1.2, -0.6, 0.8, 1.2)
    steps, multipliers = judged(planner), []
    for episode in range(1, 13):
        before = steps.virtual.price(planner.policy, episodes)
        mu = list(planner.constraints.multipliers)
        report = steps.plan(episode, episodes, episodes)
        raised, planner.constraints.multipliers = planner.constraints.multipliers, mu
        assert report["plan_accepted"] == 1.0
        assert steps.virtual.price(planner.policy, episodes) <= before
        planner.constraints.multipliers = raised
        multipliers += raised
    assert multipliers == sorted(multipliers) and multipliers[-1] - multipliers[5] < 0.1 * multipliers[5]


def test_results_say_how_often_and_how_far(tmp_path, capsys):
    planner = PlannerConfig(iterations=3, constraints=ConstraintsConfig(states={"velocity": (-0.05, 0.05)}))
    config = RunConfig(
        episodes=2,
        log_dir=tmp_path,
        unseen=3,
        figures=False,
        twinning=dataclasses.replace(SMALL, planner=planner),
    )
    run = Run(config, LinearQuadratic(horizon=2.0))
    metrics = run.train()
    speeds = run.unseen.fly(run.algorithm.policies["model_based"]).states[:, 1:, 1].abs()
    merit = metrics["summary"]["unseen"]["merit"]["model_based"]
    outside = 100.0 * (speeds > 0.05).double().mean().item()
    assert merit["velocity outside [%]"]["mean"] == pytest.approx(outside) and outside > 0.0
    assert merit["velocity beyond [m/s]"]["mean"] == pytest.approx((speeds.amax(-1) - 0.05).clamp(min=0).mean().item())
    assert "velocity outside [%]" in capsys.readouterr().out
    assert metrics["episodes"][-1]["excess/velocity"] > 0.0
    small_run(tmp_path / "free", episodes=1).train()
    assert "outside [%]" not in capsys.readouterr().out
