"""What real episodes say about the twin: the belief about policies, the referee that weighs it, and the alarm."""

import copy
import math
import random

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel
from test_algorithm import twinning

from rt_torchrl.optimisers.descent import Descended
from rt_torchrl.steps.belief import Differences, Flown, TrackRecord
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.plan import PlannerConfig, Planning
from rt_torchrl.steps.switch import Evidence, RefereeConfig, make_referee
from rt_torchrl.systems.exploration import ExplorationConfig
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.evidence.alarm import alarm
from rt_torchrl.twinning.evidence.paired_differences import (
    COMMON,
    EXPLORED,
    LARGEST,
    LOCAL,
    NOISE,
    REACH,
    Belief,
    PairedDifferences,
    difference,
)
from rt_torchrl.twinning.evidence.real_judge import RealJudge
from rt_torchrl.twinning.findings import findings, weight_vector
from rt_torchrl.twinning.judgement import Costs, Judgement


def test_the_belief_is_that_of_a_gaussian_process():
    generator = torch.Generator().manual_seed(0)
    actions = 0.2 * torch.randn(6, 4, generator=generator, dtype=torch.float64)
    values = torch.randn(6, generator=generator, dtype=torch.float64)
    exploration = torch.tensor([0.0, 0.1, 0.0, 0.02, 0.0, 0.3], dtype=torch.float64)
    kernel = ConstantKernel(COMMON**2, "fixed") + ConstantKernel(LOCAL**2, "fixed") * RBF(REACH * 2.0, "fixed")
    noise = NOISE**2 + (EXPLORED * exploration) ** 2
    oracle = GaussianProcessRegressor(kernel, alpha=noise.numpy(), optimizer=None).fit(actions, values)
    found = PairedDifferences(actions, values, exploration)
    for other in 0.2 * torch.randn(5, 4, generator=generator, dtype=torch.float64):
        mean, deviation = oracle.predict(other[None].numpy(), return_std=True)
        assert found.belief(other) == pytest.approx((mean.item(), deviation.item()), rel=1e-9)


def test_the_difference_of_two_policies_is_that_of_a_gaussian_process():
    """The oracle has the joint covariance, which two separate beliefs lack."""
    generator = torch.Generator().manual_seed(0)
    actions = 0.2 * torch.randn(6, 4, generator=generator, dtype=torch.float64)
    kernel = ConstantKernel(COMMON**2, "fixed") + ConstantKernel(LOCAL**2, "fixed") * RBF(REACH * 2.0, "fixed")
    oracle = GaussianProcessRegressor(kernel, alpha=NOISE**2, optimizer=None).fit(actions, torch.zeros(6))
    found = PairedDifferences(actions, torch.zeros(6, dtype=torch.float64))
    for one in 0.2 * torch.randn(4, 4, generator=generator, dtype=torch.float64):
        for other in (actions[0], one + 0.01, one + 1.0):
            covariance = oracle.predict(torch.stack([one, other]).numpy(), return_cov=True)[1]
            expected = (covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1]) ** 0.5
            assert found.deviation_between(one, other) == pytest.approx(expected, rel=1e-6)
        assert found.deviation_between(one, one.clone()) == 0.0


def test_a_policy_that_flew_is_known_and_one_far_away_is_not():
    flown = torch.zeros(3, 8, dtype=torch.float64)
    found = PairedDifferences(flown, torch.full((3,), 1.5, dtype=torch.float64))
    near, far = found.belief(flown[0]), found.belief(flown[0] + 1.0)
    assert near.mean == pytest.approx(1.5, rel=0.02) and near.deviation < NOISE
    assert abs(far.mean) < 0.1 and far.deviation > 0.9 * LOCAL


def test_without_episodes_the_belief_is_the_prior():
    found = PairedDifferences(torch.empty(0, 1, dtype=torch.float64), torch.empty(0, dtype=torch.float64))
    assert found.belief(torch.zeros(8, dtype=torch.float64)) == (0.0, pytest.approx(math.hypot(COMMON, LOCAL)))


def test_numbers_that_differ_are_refused():
    with pytest.raises(ValueError, match="2 policies, 1 differences and 1 explorations"):
        PairedDifferences(torch.zeros(2, 3, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))


@pytest.mark.parametrize(
    "real, predicted, d",
    [
        (2.0, 1.0, math.log(2.0)),
        (-1.0, -2.0, 0.0),
        (1.0, -2.0, 0.0),
        (1.0, math.inf, LARGEST),
        (1.0, 0.0, 0.0),
        (1e9, 1.0, LARGEST),
    ],
)
def test_paired_differences(real, predicted, d):
    assert difference(real, predicted) == pytest.approx(d)


def evidence(live, idle, difference, contradicted=True):
    judged = {"difference": lambda: difference, "contradicted": lambda: contradicted}
    return Evidence(live_cost=live, idle_cost=idle, idle_weight_change=1.0, **judged)


def decided(live, idle, difference, contradicted=True):
    """What the referee decides while the model-based policy is live."""
    found = evidence(live, idle, difference, contradicted)
    return make_referee(RefereeConfig(rule="weight_of_evidence"), "model_based").decide(found)


KNOWN, UNKNOWN, ALIKE = Belief(0.0, 0.03), Belief(0.0, 0.5), Belief(0.0, 0.0)


@pytest.mark.parametrize(
    "live, idle, difference, event",
    [
        (10.0, 1.0, UNKNOWN, "swap"),  # ten times better on the twin: one episode is enough
        (1.0, 1.2, UNKNOWN, "swap"),  # it may be better by half, over five episodes
        (1.0, 1.2, KNOWN, "keep"),
        (1.0, 3.0, UNKNOWN, "keep"),
        (0.04, 0.11, Belief(-1.7, 0.3), "swap"),  # the twin says 0.04 of what costs 0.22
        (1.0, math.inf, KNOWN, "keep"),
        (math.inf, 1.0, KNOWN, "swap"),
        (1.0, -1.0, KNOWN, "swap"),
        (-1.0, 1.0, KNOWN, "keep"),
        (1.0, 1.0, ALIKE, "keep"),
        (1.0, 0.9, ALIKE, "swap"),
        (-1.0, -2.0, KNOWN, "swap"),
        (-2.0, -1.0, UNKNOWN, "keep"),
    ],
)
def test_who_acts_follows_from_what_is_at_stake(live, idle, difference, event):
    assert decided(live, idle, difference) == event


@pytest.mark.parametrize(
    "live, idle, event",
    [(1.0, 1.05, "keep"), (1.0, 0.999, "swap"), (1.0, 1.0, "keep"), (1.0, math.inf, "keep"), (-1.0, -1.1, "swap")],
)
def test_the_twin_says_who_acts_as_long_as_no_real_episode_contradicts_it(live, idle, event):
    """However uncertain the difference: a dearer policy flew every second episode of a turbine whose twin was right."""
    assert decided(live, idle, UNKNOWN, contradicted=False) == event


def test_a_trial_is_not_followed_by_another_one_back():
    """The second policy took over on trial and now counts as slightly cheaper; the first one is as uncertain."""
    referee = make_referee(RefereeConfig(rule="weight_of_evidence"), "model_based")
    assert referee.decide(evidence(1.0, 1.2, UNKNOWN)) == "swap" and referee.on_trial
    back = Belief(0.0, 0.3)
    assert decided(1.0, 1.1, back) == "swap"  # one that is not on trial would be left
    assert referee.decide(evidence(1.0, 1.1, back)) == "keep" and referee.preferred == "model_free"


@pytest.mark.parametrize(
    "live, idle, difference, preferred",
    [
        (1.0, 1.2, UNKNOWN, "model_based"),  # live on trial, and expected to cost more
        (10.0, 1.0, UNKNOWN, "model_free"),
        (1.0, 1.2, KNOWN, "model_based"),
        (math.inf, 1.0, KNOWN, "model_free"),
    ],
)
def test_a_policy_on_trial_is_not_the_preferred_one(live, idle, difference, preferred):
    referee = make_referee(RefereeConfig(rule="weight_of_evidence"), "model_based")
    referee.decide(evidence(live, idle, difference))
    resumed = make_referee(RefereeConfig(rule="weight_of_evidence"), "model_free")
    resumed.load_state_dict(referee.state_dict())
    assert referee.preferred == resumed.preferred == preferred
    resumed.decide(evidence(1.0, 5.0, KNOWN))  # the trial ends
    assert resumed.preferred == resumed.live


@pytest.mark.parametrize("contradicted", [False, True])
def test_two_identical_policies_never_change_roles(contradicted):
    """Real episodes cost twice what the twin says, or as much; either policy has the same weights in every episode."""
    found = twinning(referee=RefereeConfig(rule="weight_of_evidence", clone_patience=99), judged_updates=False)
    report_costs(found, 2.0 if contradicted else 1.0)
    live = found.referee.live

    def same():
        for policy in found.policies.values():
            policy.load_state_dict(found.policies[live].state_dict())
        return findings()

    found.update_model_free, learn = lambda: (learn(), same())[0], found.update_model_free
    found.plan, plan = lambda: (plan(), same())[0], found.plan
    events = [found.episode()["event"] for _ in range(8)]
    assert events == ["keep"] * 8 and found.referee.live == live


def test_a_state_without_trials_is_read():
    referee = make_referee(RefereeConfig(rule="weight_of_evidence"), "model_free")
    referee.load_state_dict({"live": "model_based", "stall_count": 2})
    assert (referee.preferred, referee.stall_count, referee.on_trial) == ("model_based", 2, 0)


def test_stakes_are_those_of_a_simulation():
    from rt_torchrl.steps.switch import stakes

    mean, deviation, draws = math.log(1.1), math.hypot(0.3, 0.05), random.Random(0)
    ratios = [math.exp(draws.gauss(mean, deviation)) for _ in range(200_000)]
    expected = [sum(max(0.0, sign * (1.0 - ratio)) for ratio in ratios) / len(ratios) for sign in (1.0, -1.0)]
    assert stakes(evidence(1.0, 1.1, Belief(0.0, deviation))) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    "differences, wrong",
    [
        ((), False),
        ((2.0,), False),  # one episode may be chance
        ((1.7, 1.8), True),
        ((0.5, -0.5, 0.4, -0.3, 0.1), False),
        ((0.02, 0.03, 0.02), False),  # off zero, but it does not matter
        ((0.2, 0.15, 0.25, 0.2, 0.18), True),
        ((3.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0), False),  # what is long ago no longer counts
        ((-0.7, -0.69, -0.71), True),
        ((0.1, 0.9, 1.85), True),  # two in a row are no chance, however they scatter
        ((1.67, 0.15, 0.14, 0.12, 0.13), True),  # one bad policy does not hide the others
        ((1.67, 0.0, 0.02, -0.03, 0.05), False),
        ((0.0, 0.02, 0.75), True),  # a single episode that costs over twice what the twin says
        ((0.0, 0.02, -0.75), True),
        ((0.0, 0.02, 0.65), False),
    ],
)
def test_the_alarm(differences, wrong):
    assert (alarm(differences) is not None) == wrong


def test_the_alarm_says_how_wrong_the_twin_is():
    assert "the last 2 episodes cost 5.75 times as much as the twin says" in alarm((1.7, 1.8))
    assert "cost 1/2.01 of what the twin says" in alarm((-0.7, -0.69, -0.71))
    assert "the last 2 episodes cost 1.22 times as much" in alarm((-0.4, 0.0, 0.2, 0.2))
    assert "the last episode cost 2.72 times as much as the twin says of it" in alarm((0.0, 0.0, 1.0))


def test_false_alarms_of_a_sound_twin_are_rare():
    draws, alarms = random.Random(1), 0
    for _ in range(2000):
        alarms += alarm([draws.gauss(0.0, 0.05) for _ in range(5)]) is not None
    assert alarms / 2000 < 0.05


class ByGain(VirtualEpisodes):
    """Virtual episodes on which a policy costs its gain; the twin knows nothing else."""

    def __init__(self, plant):
        self.twin = DigitalTwin(plant, plant.closure)

    def cost(self, policy, episodes):
        return policy.gain.detach().sum()


def differences_of(policies, said, differences, record):
    """Paired differences of flights, where the twin says these costs of their policies."""
    costs = [cost * math.exp(d) for cost, d in zip(said, differences, strict=True)]
    flights = [Flown(record, "model_based", {}, cost) for cost in costs]
    return Differences(policies, differences, [0.0] * len(policies), flights)


def judge_of(gains, differences):
    plant = LinearQuadratic(horizon=2.0)
    generator = torch.Generator().manual_seed(0)
    state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    flown = Rollout(plant, plant.closure, LinearGain([[1.0, 1.0]]))(state, exogenous)
    record = Trajectory(flown.states[0], flown.actions[0], exogenous[0])
    found = differences_of([LinearGain([[gain, 0.0]]) for gain in gains], gains, differences, record)
    return RealJudge(found, found.learned(plant, record), ByGain(plant), record)


def test_a_policy_that_cost_more_than_the_twin_said_is_expected_to_cost_it_again():
    judge = judge_of([4.0, 4.0], [1.0, 1.0])
    assert judge.expected(LinearGain([[4.0, 0.0]]), 4.0) == pytest.approx(4.0 * math.e, rel=0.03)
    assert judge.expected(LinearGain([[4.0, 0.0]]), -4.0) == -4.0


def test_a_twin_that_blew_up_makes_no_neighbour_cheaper_than_its_flight():
    """The twin says 40 of a flight that cost 0.54, and of a neighbour more than that, or less."""
    judge, policy = judge_of([40.0, 40.0], [-4.3, -4.3]), LinearGain([[40.0, 0.0]])
    flight = 40.0 * math.exp(-4.3)
    for cost, expected in ((80.0, 2.0 * flight), (40.0, flight), (5.0, flight), (0.6, flight), (0.3, 0.3)):
        assert judge.expected(policy, cost) == pytest.approx(expected, rel=0.04)
    assert judge.belief(policy, 0.3).mean == 0.0 and judge.median(policy, 0.3) == 0.3
    assert judge.expected(policy, math.inf) == math.inf


def test_who_costs_more_on_the_twin_is_expected_to_cost_more():
    judge, policy = judge_of([40.0, 3.0, 1.0], [-4.3, -1.2, 0.3]), LinearGain([[40.0, 0.0]])
    costs = [judge.expected(policy, 0.05 * 1.1**k) for k in range(90)]
    assert all(more >= 0.999 * less for less, more in zip(costs, costs[1:], strict=False))


def test_a_twin_that_is_merely_wrong_tells_of_all_neighbours():
    judge, policy = judge_of([40.0, 40.0], [-0.9, -0.9]), LinearGain([[40.0, 0.0]])
    assert judge.belief(policy, 0.4).mean == pytest.approx(-0.9, rel=0.03)
    judge = judge_of([0.4, 0.4], [3.0, 3.0])
    assert judge.belief(LinearGain([[0.4, 0.0]]), 0.01).mean == pytest.approx(3.0, rel=0.03)


def test_weights_are_recalled_that_are_expected_to_cost_less():
    """The twin says 2 of the present policy, which cost e² times as much, and 4 of an earlier one, which cost it."""
    judge = judge_of([4.0, 2.0], [0.0, 2.0])
    episodes = Scenario(torch.zeros(1, 2).double(), torch.zeros(1, 20, 1).double())
    recalled = judge.recalled(LinearGain([[2.0, 0.0]]), episodes)
    assert recalled["gain"].tolist() == [[4.0, 0.0]]
    assert judge.recalled(LinearGain([[4.0, 0.0]]), episodes) is None
    assert judge_of([], []).recalled(LinearGain([[2.0, 0.0]]), episodes) is None


@pytest.mark.parametrize(("earlier", "d"), [(4.0, [-2.0, 0.0]), (1.5, [0.0, -2.0])])
def test_luck_recalls_nothing(earlier, d):
    """The present policy, of which the twin says 2, flew for no more; an earlier one, which flew, for 0.54 or 1.5."""
    judge = judge_of([earlier, 2.0], d)
    episodes = Scenario(torch.zeros(1, 2).double(), torch.zeros(1, 20, 1).double())
    assert judge.recalled(LinearGain([[2.0, 0.0]]), episodes) is None


def report_costs(found, factor):
    """Let the real system report its costs multiplied by a factor."""
    fly = found.flights.fly

    def flown(policy, *, strength, whole):
        flight = fly(policy, strength=strength, whole=whole)
        flight.transitions["next", "reward"] *= factor
        return flight

    found.flights.fly = flown


@pytest.mark.parametrize("corrected", [False, True])
def test_a_training_goes_back_to_what_was_better_in_reality(corrected):
    """The twin's plans cost ten times as much on the real system, which the paired differences show."""
    found = twinning(arm="model_based", corrected_plans=corrected)
    fly, costs = found.flights.fly, []

    def flown(policy, *, strength, whole):
        flight = fly(policy, strength=strength, whole=whole)
        rewards = flight.transitions["next", "reward"]
        flight.transitions["next", "reward"] = rewards * (1.0 if not costs else 10.0)
        costs.append(flight.cost)
        return flight

    found.flights.fly = flown
    reports = [found.episode() for _ in range(3)]
    assert any(report["recalled"].item() for report in reports) == corrected


@pytest.mark.parametrize(
    ("plan", "stays", "withheld"),
    [
        (Costs(1.0, 5.0, 4.0), Costs(2.0, 2.1, 2.0), math.log(2.0)),
        (Costs(1.0, 2.2, 1.5), Costs(2.0, 2.1, 2.0), 0.0),  # the belief is wide, but real episodes do not contradict
        (Costs(3.0, 9.0, 8.0), Costs(2.0, 2.1, 2.0), 0.0),  # the twin does not prefer it
        (Costs(math.inf, math.inf, math.inf), Costs(2.0, 2.1, 2.0), 0.0),
    ],
)
def test_what_evidence_withholds(plan, stays, withheld):
    assert plan.withheld(stays) == pytest.approx(withheld)


@pytest.mark.parametrize(("withheld", "wrong"), [(0.0, False), (0.09, False), (math.log(1.65), True)])
def test_a_plan_that_real_episodes_contradict_raises_the_alarm(withheld, wrong):
    told = twinning(arm="model_based").examination.told(findings(plan_accepted=0.0, withheld=withheld))
    assert ("alarm" in told) == wrong
    assert not wrong or "a plan would cost 1/1.65 of the policy that stays" in told["warning"]


class Content:
    """A planner that leaves the policy as it is."""

    def __init__(self, policy):
        self.policy = policy

    def plan(self, episodes):
        return Descended(1.0, 1.0, 0.0, 0)

    def refuse(self, *state):
        pass

    restart = load_state_dict = state_dict = refuse


def test_the_report_says_what_a_recall_withholds():
    """The twin says 2 of the present policy, which cost e² times as much, and 4 of an earlier one, which cost it."""
    judge, policy = judge_of([4.0, 2.0], [0.0, 2.0]), LinearGain([[2.0, 0.0]])
    planning = Planning(Content(policy), judge.virtual, PlannerConfig())
    judgement = Judgement(lambda a, b: a > b, TrackRecord({}), judge)
    episodes = Scenario(torch.zeros(1, 2).double(), torch.zeros(1, 20, 1).double())
    report = planning.plan(1, episodes, episodes, judgement)
    assert policy.gain.tolist() == [[4.0, 0.0]] and report["recalled"] == 1.0
    assert report["withheld"].item() == pytest.approx(math.log(2.0))


@pytest.mark.parametrize(
    ("said", "d", "withheld"),
    [
        (2.0, 2.0, math.log(1.5)),
        (2.0, 0.1, 0.0),  # within chance
        (2.0, 0.3, 0.0),  # it cost 2.7, less than the policy that stays
        (4.0, 2.0, 0.0),  # the twin does not prefer it
        (2.0, -2.0, 0.0),
    ],
)
def test_what_a_flown_episode_refutes_stays_refuted(said, d, withheld):
    """The twin says 3 of the policy that stays; an earlier one flew for e^d times what the twin says of it."""
    judge, policy = judge_of([said], [d]), LinearGain([[3.0, 0.0]])
    episode = Flown(judge.record, "model_based", {}, said * math.exp(d))
    judge.differences = judge.differences._replace(flown=[episode])
    judge.recalled, judge.median = lambda policy, episodes: None, lambda policy, cost: cost
    planning = Planning(Content(policy), judge.virtual, PlannerConfig())
    judgement = Judgement(lambda a, b: a > b, TrackRecord({}), judge)
    episodes = Scenario(torch.zeros(1, 2).double(), torch.zeros(1, 20, 1).double())
    report = planning.plan(1, episodes, episodes, judgement)
    assert float(report.get("withheld", 0.0)) == pytest.approx(withheld)


@pytest.mark.parametrize(("spread", "raised"), [(0.02, [0.0, 1.0]), (0.2, [0.0, 0.0])])
def test_episodes_that_explore_raise_no_alarm(spread, raised):
    """The twin is the real system, whose costs are doubled; chance explains that where actions scatter by a fifth."""
    plant = LinearQuadratic(horizon=2.0)
    loud = ExplorationConfig(spread=spread, episodes=10**6)
    found = twinning(plant, closure=copy.deepcopy(plant.closure), arm="model_based", exploration=loud)
    report_costs(found, 2.0)
    reports = []
    for _ in range(2):
        found.interact()
        reports.append(found.examination.examine())
    assert [report["alarm"].item() for report in reports] == raised
    assert not raised[1] or "times as much as the twin says of them" in reports[1]["warning"]
    expected = abs(reports[1]["paired_difference"].item()) - (0.0 if raised[1] else 4.0 * spread)
    assert found.examination.unexplained == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("factor", "corrects"), [(1.0, False), (1.1, False), (1.3, True)])
def test_plans_are_corrected_where_a_real_episode_contradicts_the_twin(factor, corrects):
    """The twin is the real system, whose costs are reported multiplied; 15 % are beyond chance."""
    plant = LinearQuadratic(horizon=2.0)
    quiet = ExplorationConfig(spread=0.0)
    found = twinning(plant, closure=copy.deepcopy(plant.closure), arm="model_based", exploration=quiet)
    report_costs(found, factor)
    found.interact()
    assert (found.examination.correction(found.short_term[-1]) is not None) == corrects


@pytest.mark.parametrize(("factor", "contradicted"), [(1.0, False), (1.3, True)])
def test_the_referee_learns_whether_a_real_episode_contradicts_the_twin(factor, contradicted):
    plant = LinearQuadratic(horizon=2.0)
    found = twinning(plant, closure=copy.deepcopy(plant.closure), exploration=ExplorationConfig(spread=0.0))
    report_costs(found, factor)
    asked = []
    found.referee.decide = lambda evidence: asked.append((evidence.contradicted(), evidence.difference())) or "keep"
    found.episode()
    assert [said for said, _ in asked] == [contradicted] and asked[0][1].deviation > 0.0


def test_the_belief_of_the_referee_follows_from_what_the_twin_says_of_each_policy():
    """The twin says twenty times what an episode cost, as it does of the live policy, but not of its clone's costs."""
    plant = LinearQuadratic(horizon=2.0)
    found = twinning(plant, closure=copy.deepcopy(plant.closure), exploration=ExplorationConfig(spread=0.0))
    report_costs(found, 0.05)
    asked, live, idle = [], found.referee.live, found.referee.idle
    found.policies[idle].load_state_dict(found.policies[live].state_dict())
    found.interact()
    said = found.track_record.real_costs[-1] / 0.05
    found.virtual_costs = lambda episodes: {live: torch.tensor(said), idle: torch.tensor(0.1 * said)}
    found._earlier_weights = {role: weight_vector(policy) for role, policy in found.policies.items()}
    found.referee.decide = lambda evidence: asked.append(evidence.difference()) or "keep"
    found.fit_exogenous()
    found.switch_policies()
    assert asked[0].mean == pytest.approx(math.log(0.5) - math.log(0.05), rel=0.03) and asked[0].deviation == 0.0


@pytest.mark.parametrize(("exploration", "corrects"), [(0.0, True), (0.02, True), (0.1, False)])
def test_what_exploration_explains_corrects_no_plan(exploration, corrects):
    """A real episode cost 30 % more than the twin says; two standard deviations of an exploration by 0.1 are 40 %."""
    found = twinning(LinearQuadratic(horizon=2.0), arm="model_based")
    found.interact()
    record, policy = found.short_term[-1], LinearGain([[1.0, 1.0]])
    flown = [Flown(record, "model_based", {}, 1.3, exploration)]
    paired = Differences([policy], [math.log(1.3)], [exploration], flown)
    found.track_record.differences = lambda virtual: paired
    assert (found.examination.correction(record) is not None) == corrects
