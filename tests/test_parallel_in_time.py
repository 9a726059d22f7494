"""Engine parallel_in_time against marching: plants, windows, convergence, and what it does where it cannot converge."""

import warnings

import numpy as np
import pytest
import torch
from device_mode import RequireDevice
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from pretend_device import pretend_device
from test_gradients import relative_gap, seeded

from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.plants.plant import Transition
from rt_torchrl.plants.policies import SaturatedMLP
from rt_torchrl.plants.signal import differences
from rt_torchrl.trajectories.engines import newton_march
from rt_torchrl.trajectories.engines.interval import Drive, Interval
from rt_torchrl.trajectories.engines.linear_recurrence import linear_recurrence
from rt_torchrl.trajectories.engines.linearisation import prepared
from rt_torchrl.trajectories.engines.parallel_in_time import ParallelInTime
from rt_torchrl.trajectories.engines.recurrence import march
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout, drive_of
from rt_torchrl.trajectories.trajectory import control_cost

PLANTS = {
    "linear_quadratic": lambda: LinearQuadratic(horizon=40.0),
    "wind_turbine": lambda: WindTurbine(horizon=200.0),
    "flapping_wing": lambda: FlappingWing(horizon=0.2),
    "cryogenic_tank": lambda: CryogenicTank(horizon=12_000.0),
    "pendulum": lambda: Pendulum(horizon=5.0),
}


class Logistic(LinearQuadratic):
    """The map s' = 4 s (1 − s), whose errors double in every interval."""

    own_scheme = True

    def step(self, t, state, command, exogenous, closure):
        return Transition(4.0 * state * (1.0 - state), command)

    def draw_initial_state(self, batch, generator):
        return torch.rand(batch, 2, generator=generator, dtype=torch.float64, device=generator.device)


@pytest.fixture(autouse=True)
def _nothing_told(monkeypatch):
    monkeypatch.setattr(newton_march, "_told", set())


def flight(plant, *, batch=3, policy=None, seed=0):
    """An interval with its policy in the loop, an initial state and a drive."""
    generator = seeded(seed)
    policy = plant.make_policy(generator) if policy is None else policy
    exogenous = plant.draw_exogenous(batch, generator)
    drive = drive_of(plant, exogenous, None)
    return (Interval(plant, plant.closure, policy), *prepared(plant.draw_initial_state(batch, generator), drive))


class Watched(ParallelInTime):
    """The engine, which counts its Jacobians and how many it takes at once."""

    def __init__(self, memory=None, **options):
        super().__init__(compiled=False, **options)
        self.counts, whole = [], self.march.linearise
        if memory is not None:
            self.march.memory = memory  # below what a user may choose

        def counted(interval, names, starts, drive):
            self.counts.append(len(starts))
            return whole(interval, names, starts, drive)

        self.march.linearise = counted


@pytest.mark.parametrize("n", [1, 2, 3, 4, 7, 8, 100])
def test_linear_recurrence(n):
    generator = np.random.default_rng(n)
    transitions, sources = generator.normal(size=(n - 1, 2, 3, 3)) / 3.0, generator.normal(size=(n, 2, 3))
    found, state = linear_recurrence(torch.from_numpy(transitions), torch.from_numpy(sources)).numpy(), np.zeros((2, 3))
    for k in range(n):
        state = np.einsum("bij,bj->bi", transitions[k - 1], state) + sources[k] if k else sources[0]
        np.testing.assert_allclose(found[k], state, rtol=1e-12, atol=1e-13)  # rounding


@pytest.mark.parametrize("driver", ["policy", "perceptron"])
@pytest.mark.parametrize("plant", PLANTS)
def test_the_trajectory_is_that_of_marching(plant, driver):
    plant, policy = PLANTS[plant](), None
    if driver == "perceptron":
        policy = SaturatedMLP(len(plant.observations), plant.actions, generator=seeded(5))
    interval, state, drive = flight(plant, policy=policy)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.filterwarnings("error", message="engine .parallel_in_time.")
        found, marched = (
            ParallelInTime(compiled=False).end_states(interval, state, drive),
            march(interval, state, drive),
        )
    gap = differences(plant.states, found, marched).abs().amax((0, 1)) / marched.abs().amax((0, 1))
    assert gap.max() < 1e-10  # measured: 1e-14 and below


@torch.no_grad()
def test_turns_of_a_periodic_state():
    """A pendulum that turns over many times, from a guess that rests, with its angle within ±π everywhere."""
    plant = Pendulum(horizon=5.0)
    interval, _, drive = flight(plant, batch=1)
    state = torch.tensor([[0.3, 7.0]], dtype=torch.float64)
    found = ParallelInTime(compiled=False, sweeps=4).end_states(interval, state, drive)
    marched = march(interval, state, drive)
    assert (marched[1:, 0, 0] - marched[:-1, 0, 0]).abs().gt(3.0).sum() >= 3
    torch.testing.assert_close(found, marched, rtol=1e-10, atol=1e-10)


@torch.no_grad()
def test_a_linear_recurrence_takes_one_iteration():
    """s_k = M^k s_0 by numpy; the second evaluation finds that the first step was exact."""
    plant, gain = LinearQuadratic(horizon=20.0, noise=0.0), [[0.8, 0.3]]
    interval, state, drive = flight(plant, policy=LinearGain(gain))
    engine = Watched(sweeps=0)
    found = engine.end_states(interval, state, drive)
    first = prepared(torch.eye(2, dtype=torch.float64), Drive(drive.t[:1], *(x[:1, :2] for x in drive[1:])))
    matrix = march(interval, *first)[0].numpy().T
    for k in (0, 10, 199):
        exact = state.numpy() @ np.linalg.matrix_power(matrix, k + 1).T
        np.testing.assert_allclose(found[k].numpy(), exact, rtol=0, atol=1e-13)  # 200 roundings
    assert engine.counts == [600, 600]


@torch.no_grad()
def test_convergence_is_quadratic():
    """Residuals on the drone: every one is below a multiple of the square of the one before."""
    interval, state, drive = flight(PLANTS["flapping_wing"]())
    sizes = []
    for iterations in (1, 2, 3):
        engine = ParallelInTime(compiled=False, sweeps=0, iterations=iterations)
        window = newton_march._Window(interval, state, drive)
        sizes.append(engine.march._solved(window).residual)
    assert sizes[0] > 0.1 and sizes[1] < 1e-2 * sizes[0] and sizes[2] < 10.0 * sizes[1] ** 2


def test_the_memory_cuts_the_time():
    interval, state, drive = flight(PLANTS["wind_turbine"]())
    whole, cut = Watched(), Watched(memory=4 * 8 * 3 * 6**2 * 100)
    gradients = []
    for engine in (whole, cut):
        ends = engine.end_states(interval, state, drive)
        gradients.append(torch.autograd.grad((ends**2).mean(), list(interval.policy.parameters())))
    assert max(whole.counts) == 1200 and max(cut.counts) == 300
    for found, exact in zip(*gradients, strict=True):
        assert relative_gap(found, exact) < 1e-10


def test_what_does_not_converge_is_marched_with_one_warning():
    interval, state, drive = flight(Logistic(horizon=20.0), policy=LinearGain([[0.0, 0.0]]))
    engine = ParallelInTime(compiled=False, iterations=1, sweeps=0)
    message = (
        r"'parallel_in_time' marched intervals 1 to 200 of plant 'linear_quadratic': their residual was 0\.\d+ after 1 "
        r"iterations of Newton's method"
    )
    with pytest.warns(UserWarning, match=message) as told:
        found = engine.end_states(interval, state, drive)
    assert torch.equal(found, march(interval, state, drive))
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="engine .parallel_in_time.")
        engine.end_states(interval, state, drive)


def test_divergence_is_that_of_marching_without_another_warning():
    class Explosive(LinearClosure):
        def forward(self, features):
            return features**3

    plant = LinearQuadratic(horizon=20.0)
    state = torch.tensor([[0.0, 0.0], [4.0, 0.0]], dtype=torch.float64)
    zeros, messages = torch.zeros(2, 200, 1, dtype=torch.float64), []
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="engine .parallel_in_time.")
        for engine in ("parallel", "parallel_in_time"):
            with pytest.raises(DivergenceError) as error:
                Rollout(plant, Explosive(plant.true_closure), engine=engine)(state, zeros, zeros)
            messages.append(str(error.value).split("; the state before")[0])
    assert messages[0] == messages[1] and "in realisation 1 at t = " in messages[0]


@pytest.mark.parametrize(
    "options, message",
    [
        ({"tolerance": 0.0}, "tolerance=0.0 of engine 'parallel_in_time' must be positive"),
        ({"tolerance": float("nan")}, "tolerance=nan"),
        ({"iterations": 0}, "iterations=0 of engine 'parallel_in_time' must be at least 1"),
        ({"sweeps": -1}, "sweeps=-1 of engine 'parallel_in_time' must be at least 0"),
        ({"memory": 1000.0}, "memory=1000.0 .* must be finite and at least 1048576 bytes"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ParallelInTime(compiled=False, **options)


def test_every_tensor_lies_on_the_device_of_the_data():
    plant = LinearQuadratic(horizon=8.0)
    policy, state, exogenous = plant.make_policy(seeded()), *drawn(plant)
    here = gradient(plant, policy, state, exogenous)
    with pretend_device() as device, RequireDevice() as watch:
        there = gradient(plant.to(device), policy.to(device), state.to(device), exogenous.to(device))
        assert {part.device for part in there} == {device} and not watch.found
        there = [part.cpu() for part in there]
    for found, exact in zip(there, here, strict=True):
        torch.testing.assert_close(found, exact, rtol=1e-13, atol=0)


def drawn(plant):
    generator = seeded()
    return plant.draw_initial_state(2, generator), plant.draw_exogenous(2, generator)


def gradient(plant, policy, state, exogenous):
    flown = Rollout(plant, plant.closure, policy, engine="parallel_in_time")(state, exogenous)
    return torch.autograd.grad(control_cost(plant, flown).sum(), list(policy.parameters()))
