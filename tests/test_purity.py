"""What is no function of its arguments is refused in words, by every engine and on every path that flies it."""

import pytest
import torch
from impure import Recurrent, Rows
from linear_quadratic import LinearQuadratic
from torch import nn

from rt_torchrl.programs.contract import ImpureError
from rt_torchrl.systems.collectors import EpisodeCollector, collector_of
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.trajectories.rollout import ENGINES, Rollout
from rt_torchrl.trajectories.twin import DigitalTwin


class Summing(nn.Module):
    """A PI controller whose integral is a buffer."""

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.ones(2, dtype=torch.float64))
        self.register_buffer("integral", torch.zeros(1, dtype=torch.float64))

    def forward(self, observation):
        self.integral += 0.1 * observation.detach().mean()
        return (observation * self.gain).sum(-1, keepdim=True) + self.integral


class Derivative(nn.Module):
    """Takes the difference to the last observation."""

    def __init__(self):
        super().__init__()
        self.gain, self.last = nn.Parameter(torch.ones(1, dtype=torch.float64)), 0.0

    def forward(self, observation):
        change, self.last = observation[..., :1] - self.last, observation[..., :1].detach().mean()
        return self.gain * change


class Counter(Derivative):
    def forward(self, observation):
        self.last += 1.0
        return self.gain * observation[..., :1] + 1e-3 * self.last


class Random(Derivative):
    def forward(self, observation):
        return self.gain * observation[..., :1] + 0.1 * torch.rand(1, dtype=torch.float64)


class Centred(Derivative):
    def forward(self, observation):
        return self.gain * (observation[..., :1] - observation[..., :1].mean())


AGAIN = "gives something else when it is called again with the same arguments"
POLICIES = {
    "recurrent": (Recurrent, rf"policy \(Recurrent\) {AGAIN}.*a state of the plant"),
    "integral": (Summing, r"policy \(Summing\) changes its buffer 'integral'"),
    "derivative": (Derivative, rf"policy \(Derivative\) {AGAIN}"),
    "counter": (Counter, rf"policy \(Counter\) {AGAIN}"),
    "random": (Random, rf"policy \(Random\) {AGAIN}.*random numbers belong in draw_exogenous"),
    "dropout": (
        lambda: Rows(nn.Linear(2, 8), nn.Dropout(), nn.Linear(8, 1)),
        rf"policy.layers.1 \(Dropout\) {AGAIN}.*\.eval\(\)",
    ),
    "batch normalisation": (
        lambda: Rows(nn.BatchNorm1d(2), nn.Linear(2, 1)),
        r"policy.layers.0 \(BatchNorm1d\) changes its buffer 'running_mean'.*\.eval\(\)",
    ),
    "mean over the batch": (Centred, "depends on the other realisations"),
}
PLANT = LinearQuadratic(horizon=1.0)


def scenario(batch=3):
    generator = torch.Generator().manual_seed(0)
    return PLANT.draw_initial_state(batch, generator), PLANT.draw_exogenous(batch, generator)


@pytest.mark.parametrize("kind", POLICIES)
@pytest.mark.parametrize("engine", ENGINES)
def test_a_policy_that_is_no_function_is_refused(engine, kind):
    make, message = POLICIES[kind]
    twin = DigitalTwin(PLANT, PLANT.make_closure(torch.Generator()), engine=engine)
    for batch in (1, 3) if kind != "mean over the batch" else (3,):
        policy = make()
        for ask in (twin.cost, twin.control):
            with pytest.raises(ImpureError, match=message):
                ask(policy, *scenario(batch))


@pytest.mark.parametrize("by_steps", [False, True])
@pytest.mark.parametrize("kind", ["recurrent", "dropout"])
def test_it_does_not_fly_the_simulated_plant_either(kind, by_steps):
    make, message = POLICIES[kind]
    env = PlantEnv(PLANT, seed=0)
    actor = LivePolicy(PLANT, make(), ExplorationConfig(), generator=torch.Generator().manual_seed(0))
    collector = EpisodeCollector(env, actor, PLANT) if by_steps else collector_of(env, actor, PLANT)
    with pytest.raises(ImpureError, match=message):
        collector.rollout()


@pytest.mark.parametrize("kind", ["dropout", "batch normalisation"])
@pytest.mark.parametrize("engine", ["native", "autograd"])
def test_a_policy_in_evaluation_flies_until_it_trains_again(engine, kind):
    make, message = POLICIES[kind]
    policy = make().eval()
    fly = Rollout(PLANT, PLANT.closure, policy, engine=engine)
    exact = Rollout(PLANT, PLANT.closure, policy, engine="autograd")
    torch.testing.assert_close(fly(*scenario()).states, exact(*scenario()).states)
    policy.train()
    with pytest.raises(ImpureError, match=message):
        fly(*scenario())


class Noisy(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous) * (1.0 + torch.rand(()))


class Shaken(LinearQuadratic):
    def vector_field(self, t, state, action, exogenous, closure):
        return super().vector_field(t, state, action, exogenous, closure) + 0.1 * torch.randn_like(state)


@pytest.mark.parametrize("engine", ["native", "autograd"])
def test_a_plant_that_is_no_function_is_refused(engine):
    plant = Shaken(horizon=1.0)
    with pytest.raises(ImpureError, match=f"a method of plant 'linear_quadratic' {AGAIN}"):
        Rollout(plant, plant.closure, engine=engine)(*scenario(), torch.zeros(3, 10, 1).double())


@pytest.mark.parametrize("engine", ["native", "autograd"])
def test_a_cost_that_is_no_function_is_refused(engine):
    plant = Noisy(horizon=1.0)
    policy = plant.make_policy(torch.Generator())
    with pytest.raises(ImpureError, match=f"a method of plant 'linear_quadratic' {AGAIN}"):
        Rollout(plant, plant.closure, policy, engine=engine).costs(*scenario())
