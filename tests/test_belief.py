"""The belief about what policies cost on the real system, the alarm, and the referees that judge by both."""

import copy
import math

import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from seeds_and_numbers import drawn
from tensordict import TensorDict
from test_algorithm import flown, twinning

from rt_torchrl import DescentConfig, DigitalTwin, ExplorationConfig, Rollout, Scenario
from rt_torchrl.steps.belief import HISTORY, Belief, alarm, difference
from rt_torchrl.steps.config import PlannerConfig, RefereeConfig
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.learn import Learn
from rt_torchrl.steps.report import metrics
from rt_torchrl.steps.switch import DecisionTree, Evidence, Imitation

EPISODES = Scenario(torch.zeros(1, 2).double(), torch.zeros(1, 20, 1).double())


class ByGain(VirtualEpisodes):
    """Virtual episodes on which a policy costs its gain; ``flights`` counts them."""

    def __init__(self):
        self.twin, self.extremes = DigitalTwin(PLANT, LinearClosure(PLANT.true_closure)), ()
        self.flights, self.processes = 0, [None]

    def draw(self, count):
        return EPISODES

    def cost(self, policy, episodes, deviation=None):
        self.flights += 1
        return policy.gain.detach().sum().item()


def gains(first):
    return {"gain": torch.tensor([[first, 0.0]], dtype=torch.float64)}


def said(policy):
    """What the twin says of a policy."""
    return policy.gain[0, 0].item()


PLANT = LinearQuadratic(horizon=2.0)
with torch.no_grad():
    (RECORD,) = Rollout(PLANT, PLANT.closure, LinearGain([[1.0, 1.0]]))(*drawn(PLANT)).each()


class Known(Belief):
    """The belief that knows the log of real and predicted cost of each gain; tests/test_anchored.py learns it."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.known = {}

    def correction(self, policy):
        return torch.tensor(self.known.get(said(policy), 0.0)).double()


def belief_of(*flights, corrects=True):
    """The belief after flights of gains, by the twin's and the real cost, as pairs of gain and d."""
    found = Known({"model_based": LinearGain([[0.0, 0.0]])}, ByGain(), corrects=corrects)
    for gain, d in flights:
        found.append(RECORD, "model_based", gain * math.exp(d), gains(gain))
        found.known[gain] = d
    return found


REFUTED = ((2.0, 2.0), (3.0, 0.0))
"""The twin says 2 of weights that cost 2e², and 3 of weights that cost 3."""


@pytest.mark.parametrize(
    ("real", "predicted", "d"),
    [(2.0, 1.0, math.log(2.0)), (1.0, math.inf, 5.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (1e9, 1.0, 5.0)],
)
def test_paired_differences(real, predicted, d):
    assert difference(real, predicted) == d


def test_episodes_fly_again_where_the_twin_or_they_are_new():
    found = belief_of((2.0, 0.5), (3.0, 0.7))
    assert [flight.d for flight in found.compared()] == pytest.approx([0.5, 0.7]) and found.virtual.flights == 2
    found.compared()
    assert found.virtual.flights == 2
    with torch.no_grad():
        found.virtual.twin.closure.matrix[0, 0] += 1e-12
    assert [flight.d for flight in found.compared()] == pytest.approx([0.5, 0.7]) and found.virtual.flights == 4


def test_the_latest_episodes_are_kept_and_a_saved_belief_goes_on_alike():
    found = belief_of(*[(2.0 + 0.1 * k, 0.5) for k in range(HISTORY + 3)])
    assert said(found.policy_of(found.flown[0])) == pytest.approx(2.3)
    again = Belief({"model_based": LinearGain([[0.0, 0.0]])}, ByGain())
    again.load_state_dict(copy.deepcopy(found.state_dict()))
    assert again.compared() == found.compared() and len(again.flown) == HISTORY


class Profit(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous) - 100.0


def test_a_real_episode_of_negative_cost_is_refused_where_a_belief_compares_it():
    for options in ({"arm": "model_free"}, {"referee": RefereeConfig(rule="decision_tree")}):
        assert twinning(Profit(horizon=2.0), **options).episode()["real_cost"] < 0.0
    with pytest.raises(ValueError, match=r"J_a=-\d+.* of plant 'linear_quadratic' is negative.* add a constant"):
        twinning(Profit(horizon=2.0)).episode()


@pytest.mark.parametrize(
    ("differences", "wrong"),
    [
        ((), None),
        ((0.05, -0.05, 0.1), None),
        ((0.2,), None),
        ((0.31,), "the latest real costs (1) were 1.36 times what it says"),
        ((0.16, 0.16), "the latest real costs (2) were 1.17 times what it says"),
        ((-0.16, -0.2), "the latest real costs (2) were 0.835 times what it says"),
        ((0.16, -0.16), None),
        ((0.0, 0.0, 1.0), "the latest real costs (1) were 2.72 times what it says"),
        ((1.0, 1.0, 0.1), None),
    ],
)
def test_the_alarm_says_how_wrong_the_twin_is(differences, wrong):
    said = alarm(differences)
    assert said is None if wrong is None else wrong in said


def dear_flights(found, factor_of):
    """Let the real system report its costs multiplied by a factor of the policy."""
    fly = found.flights.fly

    def flown(policy, *, strength, whole):
        flight = fly(policy, strength=strength, whole=whole)
        flight.transitions["next", "reward"] *= factor_of(policy)
        return flight

    found.flights.fly = flown


@pytest.mark.parametrize("spread", [0.02, 0.2])
@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_the_twin_flies_again_what_was_explored(spread, factor):
    """The twin is the real system: it costs the same with the same actions, and half where costs are doubled."""
    loud = ExplorationConfig(spread=spread, episodes=10**6)
    found = twinning(PLANT, closure=copy.deepcopy(PLANT.closure), arm="model_based", exploration=loud)
    dear_flights(found, lambda policy: factor)
    for _ in range(2):
        flown(found)
        report = found.belief.examine()
        assert report["paired_difference"].item() == pytest.approx(math.log(factor), abs=1e-9)
        assert report["alarm"].item() == (factor == 2.0)
    assert found.belief.unexplained == pytest.approx(math.log(factor), abs=1e-9)
    assert found.belief.contradicted == (factor == 2.0)


def test_a_plan_that_a_real_episode_refuted_does_not_come_back():
    """The twin is exact in all but the cost of its own plans, which is a hundred times as high."""
    planner = PlannerConfig(iterations=10, descent=DescentConfig(optimiser="lbfgs", rate=1.0))
    closure, quiet = LinearClosure(PLANT.true_closure), ExplorationConfig(spread=0.0)
    found = twinning(PLANT, closure=closure, arm="model_based", planner=planner, exploration=quiet)
    first, flights = found.policies["model_based"].gain.detach().clone(), []

    def factor_of(policy):
        dear = (policy.gain - first).abs().max().item() > 0.05
        flights.append(policy.gain.flatten().tolist() if dear else None)
        return 100.0 if dear else 1.0

    dear_flights(found, factor_of)
    reports = [found.episode() for _ in range(10)]
    refuted = [weights for weights in flights if weights]
    assert flights[0] is None and flights[1] and all(refuted.count(weights) == 1 for weights in refuted)
    assert reports[1]["alarm"].item() == 1.0 and not any(flights[-5:])


def test_the_cheaper_policy_acts():
    referee, inf = DecisionTree(RefereeConfig(clone_patience=0)), math.inf
    script = [(1.0, 1.0, 1.0), (1.0, 0.999, 1.0), (1.0, inf, 0.0), (inf, inf, 1.0)]
    assert [referee.decide(Evidence(*evidence)) for evidence in script] == ["keep", "swap", "clone", "keep"]
    assert referee.live == "model_based"


class Hasty:
    """A learner whose update gives its policy the refuted weights."""

    def __init__(self, policy):
        self.policy = policy

    def update(self):
        self.policy.load_state_dict(gains(2.0))
        return metrics()

    def nothing(self, *arguments):
        return {}

    restart = refuse = load_state_dict = state_dict = store = observations = nothing


@pytest.mark.parametrize(
    ("corrects", "live", "refused"),
    [(False, "model_free", False), (True, "model_based", False), (True, "model_free", True)],
)
def test_an_update_of_the_live_policy_that_flights_refute_is_taken_back(corrects, live, refused):
    belief, learner = belief_of(*REFUTED, corrects=corrects), Hasty(LinearGain([[3.0, 0.0]]))
    learned = Learn(learner, belief, 1)(TensorDict({"transitions": {}}).set_non_tensor("live", live))
    assert said(learner.policy) == (3.0 if refused else 2.0) and ("update_accepted" in learned) == refused
    expected = "update refused: model_free is expected to cost 14.8 with it, and 3.004 without"  # and 2 on the twin
    assert not refused or learned["reason"] == expected
    assert learned["weight_changes", "model_free"] == pytest.approx(0.0 if refused else 0.5)


class Other(LinearGain):
    """The same law in another architecture."""


@pytest.mark.parametrize(("corrects", "kept"), [(False, 2.0), (True, 3.0)])
def test_a_clone_replaces_weights_that_flights_refute(corrects, kept):
    live, idle = LinearGain([[3.0, 0.0]]), Other([[2.0, 0.0]])
    imitation = Imitation(belief_of(*REFUTED, corrects=corrects), 1)

    def exactly(teacher, pupil, **others):
        pupil.load_state_dict(teacher.state_dict())
        return 0.0

    imitation.imitate = exactly
    report = imitation.clone(live, idle, seen=lambda: torch.zeros(1, 2), record=RECORD, judged_on=EPISODES)
    assert said(idle) == kept and ("reason" in report) == (not corrects)


# The decision tree of step 6, on scripted costs of the live and the idle policy and weight changes of the idle one.


WORSE, BETTER, STALLED = (2.0, 1.0, 0.9), (1.0, 2.0, 0.9), (1.0, 2.0, 0.1)
SWAP, CLONE = [*["keep"] * 2, "swap"], [*["keep"] * 3, "clone"]
"""Events of as many episodes in a row that count, where P_π = 2 and P_w = 3."""


@pytest.mark.parametrize(
    "script, expected",
    [
        ([WORSE] * 6, SWAP * 2),
        # A better episode in between restarts C_π, and movement C_w.
        ([WORSE] * 2 + [BETTER] + [WORSE] * 3, ["keep"] * 3 + SWAP),
        ([STALLED] * 8, CLONE * 2),
        ([STALLED] * 3 + [BETTER] + [STALLED] * 4, ["keep"] * 4 + CLONE),
        # A worse live policy restarts C_w: the branch of the clone is not reached, stalled or not.
        ([STALLED] * 3 + [(2.0, 1.0, 0.1)] + [STALLED] * 4, ["keep"] * 4 + CLONE),
        # Equal costs are not worse, and a change equal to T_w is no stall; a little more or less is.
        ([(1.0, 1.0, 0.9)] * 4 + [(1.0, 1.0, 0.5)] * 5 + [(1.0, 1.0, 0.4999)] * 4, ["keep"] * 9 + CLONE),
        ([(0.99, 1.0, 0.9)] * 3 + [(1.01, 1.0, 0.9)] * 3, ["keep"] * 3 + SWAP),
        # An infinite cost is worse than any other.
        ([(math.inf, 1.0, 0.9)] * 3 + [(1.0, math.inf, 0.9)] * 3, SWAP + ["keep"] * 3),
    ],
)
def test_every_branch(script, expected):
    referee = DecisionTree(RefereeConfig(rule="decision_tree"), live="model_free")
    assert [referee.decide(Evidence(*evidence)) for evidence in script] == expected
    assert referee.live == ("model_based" if expected.count("swap") == 1 else "model_free")
