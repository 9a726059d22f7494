"""A safety layer in front of a machine, and the machine with it as a real system: Gymnasium's pendulum."""

import gymnasium
import pytest
import torch
from torchrl.envs import GymWrapper

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.pendulum.real import angle_and_speed
from rt_torchrl.steps.config import LearnerConfig, PlannerConfig
from rt_torchrl.systems.exploration import ExplorationConfig
from rt_torchrl.systems.reading import Actuation, Reading
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.systems.safety import SafetyConfig, SafetyLayer
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import AssimilationConfig
from rt_torchrl.twinning.config import TwinningConfig

RATE = 5.0
APPLIED = Reading(keys=("applied",), scale=2.0)


class InShares(gymnasium.ActionWrapper):
    """The pendulum's torque as a share of its greatest, as a drive may want it; the plant counts in N m."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def action(self, action):
        return 2.0 * action


class Failing(gymnasium.ObservationWrapper):
    """A system that reports NaN at one step."""

    def __init__(self, env, broken):
        super().__init__(env)
        self.broken, self.count = broken, -1

    def reset(self, **options):
        self.count = -1
        return super().reset(**options)

    def observation(self, observation):
        self.count += 1
        return observation * float("nan") if self.count == self.broken else observation


def guarded(plant, broken=-1, **options):
    """The machine behind its layer, whose limits and fallback are in the machine's own units."""
    machine = Failing(InShares(gymnasium.make("Pendulum-v1", max_episode_steps=plant.n_steps)), broken)
    config = SafetyConfig(interval=plant.dt, rates=(RATE / 2.0,), rest=(0.0,), **options)
    return SafetyLayer(GymWrapper(machine), config, fallback=(0.0,))


def real(layer, plant, **options):
    reading = Reading(of=angle_and_speed)
    return RealSystem(layer, plant, state=reading, actuation=Actuation(scale=2.0), seed=0, **options)


def test_what_was_applied_is_what_the_twin_replays():
    """A policy that asks for more than the rate allows, and a fault: the record still follows the plant's own step."""
    plant = Pendulum(horizon=3.0)
    layer = guarded(plant, broken=20, hold=0.5)
    system = real(layer, plant, applied=APPLIED)
    asked = iter([2.0, -2.0] * plant.n_steps)
    flown = system.rollout(plant.n_steps, lambda td: td.set("action", torch.full((1, 1), next(asked)).double()))[0]
    applied, action = flown["next", "applied"], flown["action"]
    assert not torch.allclose(applied, action)
    before = torch.cat([torch.zeros(1, 1).double(), applied[:-1]])
    assert ((applied - before).abs() <= RATE * plant.dt + 1e-6).all()
    # Tripped for half a second from the fault on; the fallback is reached at the rate that holds for it too.
    assert layer.report.counts["fallback"] == 10 and (applied[24:29] == 0.0).all()
    t, nothing = torch.zeros(plant.n_steps).double(), torch.zeros(plant.n_steps, 0).double()
    ends = plant.step(t, flown["state"], applied, nothing, plant.closure).state
    there = torch.ones(plant.n_steps, dtype=torch.bool)
    there[19:21] = False  # the observation that was lost, as its end and as the next start
    difference = (ends - flown["next", "state"])[there]
    wrapped = torch.remainder(difference[:, 0] + torch.pi, 2.0 * torch.pi) - torch.pi
    # Gymnasium reports in single precision.
    assert wrapped.abs().max() < 1e-5 and difference[:, 1].abs().max() < 1e-4


def test_twinning_identifies_a_machine_behind_its_layer(tmp_path):
    plant = Pendulum(horizon=2.0, guess=0.8)
    system = real(guarded(plant, log=tmp_path / "events.jsonl"), plant, applied=APPLIED)
    generator = torch.Generator().manual_seed(0)
    config = TwinningConfig(
        exploration=ExplorationConfig(spread=1.0),
        learner=LearnerConfig(critic_iterations=2, actor_iterations=2),
        assimilation=AssimilationConfig(iterations=20, inputs="record", method="levenberg_marquardt"),
        planner=PlannerConfig(iterations=0),
    )
    policies = {role: plant.make_policy(generator) for role in ("model_based", "model_free")}
    twin = DigitalTwin(plant, plant.make_closure(generator))
    ReinforcementTwinning(system, twin, **policies, config=config, generator=generator).episode()
    found, true = twin.closure.named_coefficients(), plant.closure.named_coefficients()
    for name, value in true.items():
        assert float(found[name]) == pytest.approx(float(value), rel=1e-3)
    assert "rate" in (tmp_path / "events.jsonl").read_text()


def test_a_layer_whose_actions_nobody_would_read_is_refused():
    plant = Pendulum(horizon=2.0)
    with pytest.raises(ValueError, match="applied=Reading"):
        real(guarded(plant), plant)
