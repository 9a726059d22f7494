"""Operation on a simulated clock: what acts while the algorithm learns, to the bit."""

import dataclasses
import json
import math

import pytest
import torch
from linear_quadratic import LinearQuadratic

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.optimisers.descent import DescentConfig
from rt_torchrl.steps.config import LearnerConfig, PlannerConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.exploration import ExplorationConfig
from rt_torchrl.systems.operation.acting import Crew
from rt_torchrl.systems.operation.config import OperationConfig
from rt_torchrl.systems.operation.event_log import EventLog
from rt_torchrl.systems.operation.simulated import SimulatedOperation
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import AssimilationConfig
from rt_torchrl.twinning.config import TwinningConfig

QUIET = ExplorationConfig(episodes=0)
NOISY = ExplorationConfig(episodes=3, spread=0.2)


class Stepped(PlantEnv):
    """A subclass, which is flown step by step as an operation is."""


def small(exploration):
    return TwinningConfig(
        realisations=2,
        virtual_episodes=3,
        exploration=exploration,
        learner=LearnerConfig(critic_iterations=3, actor_iterations=2, batch_size=16, critic_hidden=(8,)),
        assimilation=AssimilationConfig(iterations=2, descent=DescentConfig(rate=0.01)),
        planner=PlannerConfig(iterations=2, descent=DescentConfig(rate=0.01)),
    )


def twinning(system, *, seed=0, exploration=QUIET, **options):
    """A training; ``system`` makes the real system, or the operation of one, of plant and policies."""
    plant = LinearQuadratic(horizon=2.0)
    generator = torch.Generator().manual_seed(seed)
    policies = {role: plant.make_policy(generator) for role in ("model_free", "model_based")}
    twin = DigitalTwin(plant, plant.make_closure(generator))
    config = small(exploration)
    env = system(plant, policies, config)
    return ReinforcementTwinning(env, twin, **policies, config=config, generator=generator, **options)


def operation_of(log=None, learning=10, kind=PlantEnv, **options):
    """A function that makes the operation of a plant in simulation."""

    def made(plant, policies, config):
        crew = Crew(lambda: kind(plant), plant, policies, config.exploration, OperationConfig(**options), seed=7)
        return SimulatedOperation(crew.operator(), learning=learning, log=log)

    return made


def weights(found):
    parts = [*found.policies.values(), found.twin.closure]
    return torch.cat([w.detach().flatten() for part in parts for w in part.parameters()]).clone()


def trained(system, episodes=4, **options):
    found = twinning(system, **options)
    reports = [found.episode() for _ in range(episodes)]
    return found, reports


def test_learning_in_no_time_is_the_synchronous_run_to_the_bit():
    ahead, reports = trained(operation_of(learning=0, kind=Stepped))
    plain, expected = trained(lambda plant, policies, config: Stepped(plant))
    assert torch.equal(weights(ahead), weights(plain))
    for one, other in zip(reports, expected, strict=True):
        assert one["real_cost"] == other["real_cost"] and one["live"] == other["live"] and one["windows"] == 1.0


@pytest.mark.parametrize(("learning", "windows"), [(7, 1.0), (20, 1.0), (53, 3.0)])
def test_a_run_on_the_simulated_clock_repeats_to_the_bit(learning, windows):
    """Windows of 20 intervals: 53 intervals of learning let two more windows come in."""
    (first, reports), (again, repeated) = (trained(operation_of(learning=learning), exploration=NOISY) for _ in "ab")
    assert torch.equal(weights(first), weights(again))
    assert [report["real_cost"] for report in reports] == [report["real_cost"] for report in repeated]
    assert max(report["windows"].item() for report in reports) == windows


def test_the_log_says_when_each_version_began_to_act(tmp_path):
    log = EventLog(tmp_path / "events.jsonl")
    trained(operation_of(log, 7), episodes=3)
    events = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    taken = [event["flown"] for event in events if event["event"] == "taken"]
    assert taken == [[[0, 0]], [[20, 0], [27, 1]], [[40, 1], [47, 2]]]


@pytest.mark.parametrize("continuous", [False, True])
def test_a_run_goes_on_from_its_state_to_the_bit(continuous):
    make = lambda: twinning(operation_of(continuous=continuous), exploration=NOISY)  # noqa: E731
    whole, halves = make(), make()
    for _ in range(2):
        whole.episode(), halves.episode()
    state = halves.state_dict()
    other = make()
    other.load_state_dict(state)
    found = [(whole.episode()["real_cost"], other.episode()["real_cost"]) for _ in range(2)]
    assert all(one == two for one, two in found)
    assert torch.equal(weights(whole), weights(other))


def test_a_continuous_operation_begins_a_window_where_the_last_one_ended():
    plant = LinearQuadratic(horizon=1.0)
    policy = plant.make_policy(torch.Generator().manual_seed(0))
    found = operation_of(continuous=True)(plant, {"only": policy}, small(QUIET))
    found.hand_over("only", policy, strength=0.0)
    first, second = found.rollout(), found.rollout()
    assert torch.equal(first["next", "state"][:, -1], second["state"][:, 0])


class Constant(torch.nn.Module):
    """A policy that always commands the same."""

    def __init__(self, *values):
        super().__init__()
        self.values = torch.nn.Parameter(torch.tensor(values, dtype=torch.float64))

    def forward(self, observation):
        return self.values.expand(*observation.shape[:-1], -1)


def handed_over(plant, before, after, at, *, handover=20):
    """The commands of a window in which one constant policy takes over from another one."""
    policies = {"before": before, "after": after}
    operation = operation_of(learning=at - plant.n_steps, handover=handover)(plant, policies, small(QUIET))
    operation.hand_over("before", before, strength=0.0)
    operation.rollout()
    operation.hand_over("after", after, strength=0.0)
    return operation.rollout()[0]


def test_the_action_fades_from_one_policy_to_the_next():
    plant = LinearQuadratic(horizon=5.0)
    window = handed_over(plant, Constant(1.0), Constant(-1.0), 60)
    # A range of 4 N in 20 intervals is 0.2 N an interval.
    expected = [1.0] * 11 + [1.0 - 0.2 * k for k in range(1, 10)] + [-1.0] * 30
    torch.testing.assert_close(window["action"].flatten(), torch.tensor(expected, dtype=torch.float64))
    assert window["version"].flatten().tolist() == [0] * 10 + [1] * 40


def test_the_handover_keeps_the_actuators_own_rate():
    """Torque and pitch of the turbine move by 7500 N m and 4 deg in an interval of half a second."""
    plant = WindTurbine(horizon=30.0)
    window = handed_over(plant, Constant(4e4, 20.0), Constant(1e4, 0.0), 65, handover=1)
    action, applied = window["action"], window["next", "applied"]
    steps = action.diff(dim=0).abs().max(0).values
    assert steps[0] <= 7500.0 + 1e-6 and steps[1] <= 4.0 + 1e-9
    # Nothing is lost in the actuators, so that what the learner reads is what the policies wanted.
    torch.testing.assert_close(applied[20:], action[20:])


def test_integrators_of_the_plant_carry_over():
    """The speed error's integral is a state; its course has no step where another policy takes over."""
    plant = WindTurbine(horizon=30.0)
    window = handed_over(plant, Constant(4e4, 5.0), Constant(1e4, 0.0), 65)
    integral = window["state"][:, 3]
    slope = plant.vector_field(
        torch.zeros(60).double(), window["state"], window["next", "applied"], window["exogenous"], plant.closure
    )[:, 3]
    # Half a second is short against the window of five seconds of the integral.
    assert (integral.diff() - 0.5 * slope[:-1]).abs().max() < 0.05 * integral.diff().abs().max() + 5e-3


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("learning", -0.1),
        ("learning", math.nan),
        ("speed", 0.0),
        ("speed", math.inf),
        ("handover", 0),
        ("core", -3),
    ],
)
def test_impossible_options_are_refused(option, value):
    with pytest.raises(ValueError, match=f"{option}="):
        dataclasses.replace(OperationConfig(), **{option: value})
