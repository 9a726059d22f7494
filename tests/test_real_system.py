"""Real systems behind foreign interfaces and simulators that call, and what only a simulation can do."""

import contextlib
import threading
from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
import scipy.linalg
import torch
from linear_quadratic import LinearQuadratic, Slewing
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, GymWrapper
from torchrl.envs.utils import check_env_specs

from rt_torchrl import Actuation, PlantEnv, Reading, RealSystem, SafetyConfig, SafetyLayer
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.pendulum.real import angle_and_speed
from rt_torchrl.systems.adapters import CallingSimulator

MILLIMETRES = torch.tensor([1e3, 1e3], dtype=torch.float64)


class Rig(EnvBase):
    """The oracle plant behind a foreign interface: mm and mm/s, a volt for every half newton from 1 V up, no batch."""

    def __init__(self, plant, ends_after=None, terminates=False, **options):
        super().__init__(batch_size=[])
        self.inner, self.ends_after, self.terminates = PlantEnv(plant, **options), ends_after, terminates
        one = Unbounded(shape=(1,), dtype=torch.float64)
        two = Unbounded(shape=(2,), dtype=torch.float64)
        self.observation_spec = Composite(sensors=Composite(encoder=two, wind=one.clone()), motor=one.clone())
        self.action_spec = Composite(volts=Bounded(low=-3.0, high=5.0, shape=(1,), dtype=torch.float64))
        self.reward_spec = Unbounded(shape=(1,), dtype=torch.float64)

    def _set_seed(self, seed):
        self.inner.set_seed(seed)

    def _told(self, found):
        sensors = {"encoder": MILLIMETRES * found["state"][0], "wind": found["exogenous"][0]}
        return {"sensors": TensorDict(sensors), "motor": found["applied"][0]}

    def _reset(self, tensordict=None, **kwargs):
        self.found, self.count = self.inner.reset(), 0
        return TensorDict({**self._told(self.found), "done": torch.tensor([False])})

    def _step(self, tensordict):
        force = 0.5 * (tensordict["volts"] - 1.0)
        self.found = self.inner.step(self.found.set("action", force[None]))["next"].exclude("reward")
        self.count += 1
        done = torch.tensor([self.count == self.ends_after])
        ends = {"done": done, "terminated": done & self.terminates}
        return TensorDict({**self._told(self.found), "reward": torch.zeros(1).double(), **ends})


STATE = Reading(keys=(("sensors", "encoder"),), scale=1e-3)
WIND = Reading(keys=(("sensors", "wind"),))
VOLTS = Actuation(key="volts", scale=0.5, offset=-0.5)


def connected(plant, *, rig=None, **options):
    options = {"state": STATE, "exogenous": WIND, "actuation": VOLTS, **options}
    return RealSystem(rig or Rig(plant), plant, **options)


def test_a_scale_is_not_rounded_to_single_precision():
    action = Actuation(scale=0.01, offset=293.15).action(torch.tensor([293.16], dtype=torch.float64))
    assert action.item() == (293.16 - 293.15) / 0.01


def test_it_fulfils_its_specs():
    check_env_specs(connected(LinearQuadratic(horizon=1.0)))


@pytest.mark.parametrize("applied", [None, Reading(keys=("motor",))])
def test_its_entries_are_those_of_the_plant_itself(applied):
    plant = LinearQuadratic(horizon=2.0)
    system = connected(plant, applied=applied)
    own = PlantEnv(plant)
    found = system.reset()
    own.reset()
    own._state, own._exogenous = found["state"].clone(), system.env.inner._exogenous.clone()
    generator = torch.Generator().manual_seed(0)
    for k in range(20):
        action = 4.0 * torch.rand(1, 1, generator=generator, dtype=torch.float64) - 2.0
        one = system.step(found.set("action", action))["next"]
        other = own.step(TensorDict({"action": action.clone()}, batch_size=[1]))["next"]
        for key in ("state", "exogenous", "observation", "applied", "reward"):
            # Units there and back: rounding.
            torch.testing.assert_close(one[key], other[key], rtol=1e-12, atol=1e-13)
        assert one["truncated"].item() == one["done"].item() == (k == 19) and not one["terminated"].item()
        found = one.exclude("reward")


def test_a_controller_remembers_what_was_applied():
    """Also where the machine's motor is faster than the plant's, of which it changes by 0.1 N at most."""
    system = connected(Slewing(), rig=Rig(LinearQuadratic()), applied=Reading(keys=("motor",)), computes=True)
    found = system.reset()
    for force in (1.5, -2.0):
        found = system.step(found.set("action", torch.full((1, 1), force).double()))["next"].exclude("reward")
        assert found["state"][0, 2].item() == pytest.approx(force)


def test_a_seed_fixes_every_episode_by_its_number():
    def starts(system, count):
        found = []
        for _ in range(count):
            system.reset()
            found.append(system.rollout(10)["state"][0, 0])  # resets again, as a collector does
        return torch.stack(found)

    plant = LinearQuadratic(horizon=1.0)
    first = starts(connected(plant, seed=3), 3)
    assert torch.equal(first, starts(connected(plant, seed=3), 3))
    assert not torch.equal(first[0], first[1]) and not torch.equal(first, starts(connected(plant, seed=4), 3))
    later = connected(plant, seed=3)
    later.load_state_dict({"seed": 3, "episodes": 2})
    assert torch.equal(starts(later, 1), first[2:])


@pytest.mark.parametrize("layer", [False, True])
def test_an_episode_of_gymnasium_takes_one_reset_with_its_own_seed(layer):
    machine, plant = gymnasium.make("Pendulum-v1"), Pendulum(horizon=1.0)
    env = GymWrapper(machine)
    if layer:
        env = SafetyLayer(env, SafetyConfig(interval=plant.dt), fallback=(0.0,))
    applied = Reading(keys=("applied",)) if layer else None
    machine.reset = Mock(wraps=machine.reset)
    system = RealSystem(env, plant, state=Reading(of=angle_and_speed), applied=applied, seed=5)
    starts = [system.rollout(3)["state"][0, 0] for _ in range(3)]
    seeds = [call.kwargs["seed"] for call in machine.reset.call_args_list]
    assert len(seeds) == len(set(seeds)) == 3 and None not in seeds
    system.set_seed(5)
    assert torch.equal(system.reset()["state"][0], starts[0]) and not torch.equal(starts[0], starts[1])


def test_a_constant_stands_in_for_an_input_that_is_not_reported():
    found = connected(LinearQuadratic(), exogenous=(0.3,)).reset()
    assert found["exogenous"].tolist() == [[0.3]]


def test_a_reading_that_is_not_finite_is_refused():
    """It is refused when it is read; before that, zeros take the place of a report, and may read as anything."""
    plant = LinearQuadratic()
    share = Reading(keys=(("sensors", "encoder"),), of=lambda mm: mm / mm.abs().sum())
    system = connected(plant, rig=Rig(plant), state=share)
    assert system.reset()["state"].isfinite().all()
    plant.draw_initial_state = lambda batch, generator: torch.zeros(batch, 2).double()
    with pytest.raises(ValueError, match=r"state \['position', 'velocity'\], read from .*is not finite: \[nan, nan\]"):
        system.reset()


# What a run on a real system refuses, because only a plant in simulation can do it, and the other way round.


# A simulator that calls its controller, as an environment: its course, its ends, its failures.


PLANT = LinearQuadratic(horizon=2.0)
CALLS: list[str] = []


def oscillator(seed, controller):
    """The linear-quadratic plant as somebody else would simulate it: it owns the loop, and solves it exactly."""
    (_, _), (spring, damping) = LinearQuadratic.true_closure
    augmented = np.zeros((3, 3))
    augmented[:2] = [[0.0, 1.0, 0.0], [-1.0 + spring, -0.3 + damping, 1.0]]
    transition = scipy.linalg.expm(augmented * PLANT.dt)
    state = np.random.default_rng(seed).uniform(-1.0, 1.0, 2)
    try:
        for _ in range(PLANT.n_steps):
            (force,) = controller({"place and rate": state})
            state = (transition @ [*state, force])[:2]
        controller({"place and rate": state})
        CALLS.append("ended")
    except BaseException as error:
        CALLS.append(type(error).__name__)
        raise


def environment(simulate=oscillator, **options):
    return CallingSimulator(simulate, {"place and rate": 2}, PLANT.actions, **options)


def still(td):
    """A policy that commands nothing."""
    return td.set("action", torch.zeros((*td.batch_size, 1), dtype=torch.float64))


def test_it_is_an_environment_of_torchrl():
    env = environment()
    check_env_specs(env, seed=0)
    env.close()


def test_stepping_it_is_what_the_simulator_does_by_itself():
    told = []

    def law(reported):
        told.append(np.array(reported["place and rate"]))
        return np.array([-0.5 * told[-1][0]])

    oscillator(7, law)
    env = environment(seed=7)
    flown = env.rollout(1000, lambda td: td.set("action", -0.5 * td["place and rate"][..., :1]))
    # A call more than there are intervals: at the end, and then the simulator returns.
    assert len(flown) == PLANT.n_steps + 1 and flown["next", "done"][-1] and not flown["next", "done"][:-1].any()
    assert np.array_equal(np.array(told), flown["place and rate"].numpy())


@pytest.mark.parametrize("real", [False, True])
def test_a_simulator_at_the_end_of_its_episode_finishes_its_work(real):
    """What follows the last call of the controller, such as writing results, is done: at once in a real system."""
    env = environment()
    CALLS.clear()
    if real:
        env = RealSystem(env, PLANT, state=Reading(keys=("place and rate",)), exogenous=(0.0,))
    for count in range(2):
        env.rollout(PLANT.n_steps, still)
        assert ["ended"] * (count + real) == CALLS
    env.close()
    assert CALLS == ["ended"] * 2


@pytest.mark.parametrize("returns", [True, False])
def test_a_simulator_that_swallows_the_end_of_an_abandoned_episode_does_not_hang_the_next_reset(returns):
    """As a callback of a C library does, whose exceptions go nowhere; one that never returns is said."""
    finished, released = [], threading.Event()

    def swallowing(seed, controller):
        for _ in range(50):
            with contextlib.suppress(BaseException):
                controller({"place and rate": np.zeros(2)})
        if not returns:
            released.wait()
        finished.append(seed)

    env = environment(swallowing)
    env.rollout(3, still)
    env.patience = 30.0 if returns else 0.1
    said = pytest.raises(RuntimeError, match="has not returned 0.1 s after its episode was abandoned")
    with contextlib.nullcontext() if returns else said:
        env.reset()
    assert finished == [0] * returns
    released.set()
    env.close()


def test_an_episode_that_is_left_ends_the_simulator():
    env, threads = environment(), threading.active_count()
    CALLS.clear()
    for _ in range(3):
        env.rollout(4, still)
    env.close()
    assert CALLS == ["EpisodeAbandoned"] * 3 and threading.active_count() <= threads  # one of before may have ended


def test_a_step_without_an_episode_is_refused():
    """There is no episode before the first reset, after the end and after a failure; a reset begins a new one."""

    def breaks(seed, controller):
        controller({"place and rate": np.zeros(2)})
        raise ZeroDivisionError("blade gone")

    env, broken, nothing = environment(), environment(breaks), "no episode is running; reset"
    for row in (lambda: env.fake_tensordict(), lambda: env.rollout(1000, still)[-1]):
        with pytest.raises(RuntimeError, match=nothing):
            env.step(still(row().exclude("next")))
    assert len(env.rollout(1000, still)) == PLANT.n_steps + 1
    start = still(broken.reset())
    for message in ("blade gone", nothing):
        with pytest.raises(RuntimeError, match=message):
            broken.step(start)
