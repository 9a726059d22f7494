"""Episodes by one scan against the same episodes stepped by TorchRL's own rollout."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector

from rt_torchrl import PlantEnv, shipped_plants
from rt_torchrl.envs.cryogenic_tank.controllers import PIValve
from rt_torchrl.envs.flapping_wing.controllers import TrimmedPD
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.systems.collectors import EpisodeCollector, FlightCollector
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy


def system(plant, **options):
    """A real system, the actor on it, and the actor's policy; every call makes them alike."""
    generator = torch.Generator().manual_seed(1)
    policy = plant.make_policy(generator)
    actor = LivePolicy(plant, policy, ExplorationConfig(correlation_time=3.0 * plant.dt), generator=generator)
    return PlantEnv(plant, seed=5, **options), actor, policy


def stepped(env, actor):
    """TorchRL's own rollout."""
    return EpisodeCollector(env, actor, env.plant)


def episodes(collector, actor, policy, strengths):
    for strength in strengths:
        actor.begin(policy, strength=strength)
        yield collector.rollout()


def compare(make, strengths=(1.0, 0.0), **tolerance):
    found = []
    for collector in (FlightCollector, stepped):
        env, actor, policy = make()
        found.append((env, list(episodes(collector(env, actor), actor, policy, strengths))))
    (env, flown), (reference, expected) = found
    for one, other in zip(flown, expected, strict=True):
        assert set(one.keys(True, True)) == set(other.keys(True, True))
        for key in other.keys(True, True):
            torch.testing.assert_close(one[key], other[key], msg=lambda text, key=key: f"{key}: {text}", **tolerance)
    for key, value in reference.state_dict().items():  # the same draws were made
        assert torch.equal(torch.as_tensor(env.state_dict()[key]), torch.as_tensor(value)), key


@pytest.mark.parametrize("kind", [FlightCollector, stepped])
def test_an_episode_is_that_of_torchrls_own_collector(kind):
    plant, flown = LinearQuadratic(horizon=2.0), []

    def torchrls(env, actor):
        env.pass_over()
        module = TensorDictModule(actor, in_keys=["observation", "state", "exogenous"], out_keys=["action"])
        return Collector(env, module, frames_per_batch=plant.n_steps, total_frames=plant.n_steps)

    for make in (kind, torchrls):
        env, actor, policy = system(plant)
        collector = make(env, actor)
        actor.begin(policy, strength=1.0)
        actor.generator.manual_seed(2)  # TorchRL tries the policy before the first episode
        flown.append(next(iter(collector)))
    one, other = flown
    for key in one.keys(True, True):
        torch.testing.assert_close(one[key], other[key], rtol=1e-12, atol=1e-13, msg=str(key))


@pytest.mark.parametrize("options", [{}, {"noise": 0.02}])
def test_every_entry_is_that_of_stepping(options):
    # The same operations; batched sums of the observation may round in another order.
    compare(lambda: system(LinearQuadratic(horizon=2.0), **options), (1.0, 0.5, 0.0), rtol=1e-12, atol=1e-13)


def shortened(name):
    """A shipped plant over 40 intervals."""
    kind = shipped_plants()[name]
    return kind(horizon=40 * kind().dt)


@pytest.mark.parametrize("name", shipped_plants())
def test_every_plant_flies_as_it_steps(name):
    # Rounding, amplified by the dynamics.
    compare(lambda: system(shortened(name)), rtol=1e-9, atol=1e-9)


CONTROLLERS = {"cryogenic_tank": PIValve, "flapping_wing": TrimmedPD, "wind_turbine": JonkmanController}


@pytest.mark.parametrize("noise", [0.0, 0.001])
@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_controller_with_a_memory_flies_as_it_steps(name, noise):
    plant = shortened(name)

    def controlled():
        env, actor, _ = system(plant, noise=noise)
        return env, actor, CONTROLLERS[name](plant)

    compare(controlled, (0.3, 0.0), rtol=1e-9, atol=1e-9)


# The real system in simulation.


def test_sensors_err_by_a_share_of_what_they_read():
    plant = LinearQuadratic(horizon=30.0, noise=0.0)
    clean, noisy = (PlantEnv(plant, seed=1, noise=noise) for noise in (0.0, 0.02))
    policy = lambda td: td.set("action", torch.zeros(1, 1).double())  # noqa: E731
    true, read = (env.rollout(300, policy)[0] for env in (clean, noisy))
    ratio = (read["state"] / true["state"] - 1.0) / 0.02
    # Of 600 standard normals: mean within 4/√600, deviation within 4/√1200.
    assert ratio.mean().abs() < 0.16 and (ratio.std() - 1.0).abs() < 0.12
    # On this plant the observation is the state, and what is read at the end of a step is what the next one sees.
    assert torch.equal(read["observation"], read["state"])
    assert torch.equal(read["next", "state"][:-1], read["state"][1:])
