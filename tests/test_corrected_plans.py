"""Corrected plans: where real episodes contradict the twin, step 5 descends the cost that they lead to expect."""

import copy
import math

import pytest
import torch
from linear_quadratic import LinearQuadratic
from test_algorithm import twinning
from test_evidence import Content, differences_of
from torch import nn

from rt_torchrl.optimisers.descent import Descent, DescentConfig
from rt_torchrl.systems.exploration import ExplorationConfig
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.config import TwinningConfig
from rt_torchrl.twinning.corrected_plans import CorrectedPlans, go
from rt_torchrl.twinning.evidence.paired_differences import LEAST, NOISE, REACH, PairedDifferences
from rt_torchrl.twinning.evidence.real_judge import RealJudge
from rt_torchrl.twinning.planners import PlannerConfig, ShortHorizonConfig
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes

EPISODES = Scenario(torch.zeros(1, 2).double(), torch.zeros(1, 20, 1).double())


class Gain(nn.Module):
    """A proportional controller of one weight."""

    def __init__(self, gain):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor([[gain]], dtype=torch.float64))

    def forward(self, observation):
        return -observation[..., :1] @ self.gain


def said(policy):
    """What the twin says of a gain: it is cheapest at 4."""
    return 1.0 + (policy.gain[0, 0] - 4.0).square()


def real(gain):
    """What a gain costs in truth: it is cheapest at 2."""
    return 1.0 + (gain - 2.0) ** 2


class Twin(VirtualEpisodes):
    """Virtual episodes on which a gain costs what the twin says."""

    def __init__(self, plant):
        self.twin, self.generator = DigitalTwin(plant, plant.closure), torch.Generator().manual_seed(0)

    def price(self, policy, episodes):
        return said(policy).detach()

    def tail(self, policy, episodes):
        return 0.0


class Planner:
    """Descends what the twin says, times the correction."""

    correction = None
    plans = refused = 0

    def __init__(self, policy):
        self.policy = policy

    def plan(self, episodes):
        self.plans += 1
        factor = self.correction or (lambda policy: 1.0)
        descent = Descent(self.policy, DescentConfig(optimiser="lbfgs", rate=0.1))
        return descent.run(lambda: said(self.policy) * factor(self.policy), 60)

    def refuse(self):
        self.refused += 1

    def restart(self):
        pass

    state_dict = load_state_dict = restart


class Uncorrected(Content):
    """A planner of one's own, which knows nothing of corrections."""


def judge_of(gains, differences):
    plant = LinearQuadratic(horizon=2.0)
    generator = torch.Generator().manual_seed(0)
    state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    with torch.no_grad():
        flown = Rollout(plant, plant.closure, Gain(1.0))(state, exogenous)
    record = Trajectory(flown.states[0] * 0.4, flown.actions[0], exogenous[0])
    policies = [Gain(gain) for gain in gains]
    found = differences_of(policies, [said(policy).item() for policy in policies], differences, record)
    return RealJudge(found, found.learned(plant, record), Twin(plant), record)


def flown_with(*gains):
    """The judge after flights with these gains."""
    return judge_of(gains, [math.log(real(gain) / said(Gain(gain)).item()) for gain in gains])


def test_plans_halve_what_the_optimum_of_the_twin_costs_in_truth():
    """Each plan is flown in truth, and the next one knows of it; the twin alone stays at its own optimum of 4."""
    gains = [4.0]
    for _ in range(8):
        planner = Planner(Gain(min(gains, key=real)))
        judge = flown_with(*gains)
        found = CorrectedPlans(planner, judge.virtual).plan(EPISODES, EPISODES, judge)
        assert planner.correction is None and found["corrected"] + planner.refused == 1.0
        gains.append(planner.policy.gain[0, 0].item())
    assert real(4.0) == 5.0 and real(min(gains, key=real)) < 2.5


def test_a_planner_that_takes_no_correction_is_refused():
    with pytest.raises(ValueError, match="corrected_descents=True needs .* attribute correction; Uncorrected has none"):
        CorrectedPlans(Uncorrected(Gain(4.0)), flown_with(4.0).virtual)


@pytest.mark.parametrize(
    "options",
    [
        {"corrected_plans": False},
        {"planner": PlannerConfig(method="receding_horizon")},
        {"planner": PlannerConfig(short_horizon=ShortHorizonConfig(window=5))},
    ],
)
def test_corrected_descents_need_corrected_plans_over_whole_episodes(options):
    with pytest.raises(ValueError, match="corrected_descents=True needs corrected_plans=True, and plans over whole"):
        TwinningConfig(**{"corrected_plans": True, "corrected_descents": True} | options)


def test_a_plan_that_has_not_flown_flies_first():
    judge, planner = flown_with(1.0), Planner(Gain(4.0))
    assert not CorrectedPlans(planner, judge.virtual).plan(EPISODES, EPISODES, judge).keys() and not planner.plans


def test_a_plan_that_promises_nothing_is_left():
    """A twin that is right about all gains around: from its optimum no plan is expected to cost less."""
    gains = [3.6, 3.8, 4.0, 4.2, 4.4]
    judge, planner = judge_of(gains, [0.0] * len(gains)), Planner(Gain(4.0))
    assert CorrectedPlans(planner, judge.virtual).plan(EPISODES, EPISODES, judge)["corrected"] == 0.0
    assert planner.policy.gain.tolist() == [[4.0]] and planner.plans == planner.refused == 1


def test_the_correction_has_exact_gradients():
    judge = flown_with(4.0, 3.0, 2.5)

    def factor(gain):
        policy = Gain(0.0)
        del policy.gain
        policy.gain = gain
        return judge.factor(policy)

    assert torch.autograd.gradcheck(factor, torch.tensor([[3.3]], dtype=torch.float64, requires_grad=True))


def test_a_twin_that_blew_up_does_not_make_its_neighbours_cheap():
    judge = judge_of([4.0], [-5.0])
    assert judge.expected(Gain(4.0), 1.0) == pytest.approx(math.exp(-5.0), rel=0.1)
    assert judge.dearest(Gain(4.0), 1.0) == pytest.approx(math.exp(LEAST), rel=0.05)
    assert judge.dearest(Gain(4.0), -1.0) == -1.0


def test_neighbours_that_differ_lead_no_further_than_they_say():
    """The belief itself goes beyond, as it must: a slope of 0.8 between two policies at a fifth of the reach."""
    judge = judge_of([4.0, 4.4], [0.4, -0.4])
    means = [judge.limited.posterior(judge.shares(Gain(gain / 10.0)))[0].item() for gain in range(90)]
    factors = [judge.factor(Gain(gain / 10.0)).item() for gain in range(90)]
    assert min(means) < -0.45
    assert math.exp(-0.4) <= min(factors) and max(factors) <= math.exp(0.4 + 0.15)


@pytest.mark.parametrize(("differences", "noisy"), [([0.3, 0.32, 0.29], False), ([0.4, -0.4, 0.1], True)])
def test_luck_that_does_not_cancel_is_noise(differences, noisy):
    """Three flights with the same weights."""
    judge = judge_of([4.0] * 3, differences)
    assert (judge.limited.noise > 2.0 * NOISE) == noisy


def test_the_likelihood_is_that_of_a_normal_distribution():
    actions = torch.tensor([[0.0], [0.1], [0.3]], dtype=torch.float64)
    found = PairedDifferences(actions, torch.tensor([0.2, -0.1, 0.4], dtype=torch.float64), noise=0.2)
    covariance = found._kernel(actions) + 0.04 * torch.eye(3, dtype=torch.float64)
    normal = torch.distributions.MultivariateNormal(torch.zeros(3, dtype=torch.float64), covariance)
    constant = 1.5 * math.log(2.0 * math.pi)
    assert found.log_likelihood() == pytest.approx(normal.log_prob(found.differences).item() + constant)


class Saturated(nn.Module):
    """A policy whose action does not depend on its weight."""

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.zeros(1, 1).double())


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_weights_go_as_far_as_actions_differ_by_the_reach(scale):
    """The units of a weight do not matter."""
    policy, way = Gain(0.0), torch.tensor([scale], dtype=torch.float64)
    go(policy, [policy.gain], torch.zeros(1).double(), way, lambda policy: policy.gain.flatten() / scale)
    assert policy.gain[0, 0].item() / scale == pytest.approx(REACH, rel=0.2)


def test_actions_that_do_not_depend_on_the_weights_end_the_search():
    policy = Saturated()
    go(policy, [policy.gain], torch.zeros(1).double(), torch.ones(1).double(), lambda policy: torch.zeros(3))
    assert policy.gain.isfinite().all()


def test_a_training_corrects_its_plans_and_resumes_alike():
    """The twin's plans cost three times as much on the real system."""

    def training():
        found = twinning(
            arm="model_based",
            corrected_plans=True,
            corrected_descents=True,
            exploration=ExplorationConfig(episodes=0),
        )
        fly, flights = found.flights.fly, []

        def flown(policy, *, strength, whole):
            flight = fly(policy, strength=strength, whole=whole)
            flight.transitions["next", "reward"] *= 3.0 if flights or found.episodes_done else 1.0
            flights.append(flight)
            return flight

        found.flights.fly = flown
        return found

    first = training()
    reports = [first.episode() for _ in range(3)]
    kept = copy.deepcopy(first.state_dict())
    assert any("corrected" in report.keys() for report in reports)  # noqa: SIM118  (it iterates over its batch)
    again = training()
    again.load_state_dict(kept)
    weights = []
    for one in (first, again):
        one.episode()
        weights.append([w.tolist() for w in one.policies["model_based"].parameters()])
    assert weights[0] == weights[1]
