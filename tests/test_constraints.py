"""Bounds on states: their price by hand, its gradient, plans that keep them, and what results say of them."""

import dataclasses
import math

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from small_runs import SMALL, small_run

from rt_torchrl import DigitalTwin, PlannerConfig
from rt_torchrl.optimisers.descent import DescentConfig
from rt_torchrl.plants.signal import StateBounds
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import ConstraintsConfig, ExogenousConfig
from rt_torchrl.steps.constraints import Constraints
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.plan import MultiStart, WholeEpisodes
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory

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
        compiled=False,
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
