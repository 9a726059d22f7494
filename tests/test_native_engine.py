"""Engine native against backpropagation, over plants, closures, policies, batches, lengths, threads and memory."""

import warnings
from collections import OrderedDict
from contextlib import nullcontext

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import seeded
from test_gradients import OUTPUTS, PerceptronClosure, relative_gap
from torch import nn
from traced_function import marched

from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.plants.policies import SaturatedMLP
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.engines import code
from rt_torchrl.trajectories.engines.interval import Autograd, CostInterval, Drive, Interval
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.rollout import Rollout

PLANTS = {
    "linear_quadratic": LinearQuadratic,
    "wind_turbine": WindTurbine,
    "flapping_wing": FlappingWing,
    "cryogenic_tank": CryogenicTank,
    "pendulum": Pendulum,
}


@pytest.fixture(autouse=True)
def _no_substitute():
    """No engine takes the place of native unseen."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="engine 'autograd'")
        yield


class Task:
    """An interval with states and a drive of which everything has a gradient."""

    def __init__(self, plant="linear_quadratic", closure="law", driver="policy", batch=3, n=4, seed=0):
        generator = seeded(seed)
        self.plant = plant = PLANTS[plant]()
        closures = {
            "law": lambda: plant.make_closure(generator),
            "true": lambda: plant.closure,
            "perceptron": lambda: PerceptronClosure(OUTPUTS[plant.name][1], OUTPUTS[plant.name][0], generator),
        }
        policies = {
            "commands": lambda: None,
            "policy": lambda: plant.make_policy(generator),
            "perceptron": lambda: SaturatedMLP(len(plant.observations), plant.actions, generator=generator),
        }
        self.interval = Interval(plant, closures[closure](), policies[driver]())
        self.state = plant.draw_initial_state(batch, generator).requires_grad_()
        low, high = bounds(plant.actions)
        share = 0.1 + 0.8 * torch.rand(n, batch, len(low), generator=generator).double()
        command = low + share * (high - low) if driver == "commands" else torch.empty(n, batch, 0).double()
        exogenous = plant.draw_exogenous(batch, generator).transpose(0, 1)
        exogenous = exogenous.repeat(-(-n // len(exogenous)), 1, 1)[:n]
        t = (3.0 + plant.dt * torch.arange(n).double()).unsqueeze(-1)
        self.drive = Drive(*(x.detach().clone().requires_grad_() for x in (t, exogenous, command)))
        self.costate = torch.randn(n, batch, len(plant.states), generator=generator).double() / (1 + self.state.abs())

    @property
    def leaves(self):
        return [self.state, *self.drive, *(w for w in self.interval.parameters() if w.requires_grad)]

    def gradients(self, engine):
        ends = engine.end_states(self.interval, self.state, self.drive)
        return [ends.detach(), *_gradients(ends, self.leaves, self.costate)]


def _gradients(found, leaves, costate):
    pairs = zip(torch.autograd.grad(found, leaves, costate, allow_unused=True), leaves, strict=True)
    return [torch.zeros_like(x) if g is None else g for g, x in pairs]


def assert_equal(found, exact, bound=1e-10):
    """Equal but for the order of sums over at most some hundred intervals."""
    for a, b in zip(found, exact, strict=True):
        assert a.shape == b.shape
        assert torch.equal(a, b) or relative_gap(a, b) < bound


NATIVE, AUTOGRAD = Native(compiled=False), Autograd(compiled=False)


@settings(max_examples=8, deadline=None, derandomize=True)
@given(
    st.sampled_from(sorted(PLANTS)),
    st.sampled_from(["law", "true", "perceptron"]),
    st.sampled_from(["commands", "policy", "perceptron"]),
    st.integers(1, 9),
    st.integers(1, 5),
    st.integers(0, 1000),
)
def test_gradients_of_plants(plant, closure, driver, batch, n, seed):
    if closure == "perceptron" and plant not in OUTPUTS:
        closure = "law"
    task = Task(plant, closure, driver, batch, n, seed)
    assert_equal(task.gradients(NATIVE), task.gradients(AUTOGRAD))


@pytest.mark.parametrize("batch", [1, 2, 7, 8, 9, 17])
def test_every_batch(batch):
    task = Task(batch=batch, n=2)
    assert_equal(task.gradients(NATIVE), task.gradients(AUTOGRAD), 1e-13)


@pytest.mark.parametrize("n", [1, 2, 300])
@pytest.mark.parametrize("driver", ["commands", "policy"])
def test_every_length(n, driver):
    task = Task(driver=driver, n=n)
    assert_equal(task.gradients(NATIVE), task.gradients(AUTOGRAD), 1e-12)


def test_a_drive_in_any_memory_layout():
    """One row for all realisations, every second interval, and the batch first."""
    task = Task(driver="commands", batch=11, n=6)
    t, z, a = (x.detach() for x in task.drive)
    z, a = z[:1, :1].expand(6, 11, -1), a.transpose(0, 1).contiguous().transpose(0, 1)
    t = torch.stack([t, t + 1.0], 1).flatten(0, 1)[::2]
    task.drive = Drive(t.requires_grad_(), z.requires_grad_(), a.requires_grad_())
    assert_equal(task.gradients(NATIVE), task.gradients(AUTOGRAD))


def test_threads_give_the_same():
    task, threads = Task(batch=21, n=900), torch.get_num_threads()
    whole = [task.gradients(NATIVE), costs(task, NATIVE)]
    try:
        for number in (1, 2):
            torch.set_num_threads(number)
            for found, exact in zip([task.gradients(NATIVE), costs(task, NATIVE)], whole, strict=True):
                assert_equal(found, exact, 1e-13)
    finally:
        torch.set_num_threads(threads)


def costs(task, engine):
    """Costs and gradients, by other cotangents for each realisation."""
    found = engine.costs(CostInterval(task.interval), task.state, task.drive)
    return [found.detach(), *_gradients(found, task.leaves, torch.arange(1.0, 1 + len(found)).double())]


@pytest.mark.parametrize("plant", PLANTS)
def test_costs(plant):
    task = Task(plant, batch=5, n=6)
    costed = CostInterval(task.interval)
    state = torch.cat([task.state, task.state.new_zeros(5, 1)], -1)
    exact = marched(costed, state, *task.drive)[-1, :, -1] / 6.0
    wanted = [exact.detach(), *_gradients(exact, task.leaves, torch.arange(1.0, 6.0).double())]
    assert_equal(costs(task, NATIVE), wanted)


def test_costs_keep_the_gradients_of_their_weights():
    task = Task()
    exact, found = costs(task, NATIVE), NATIVE.costs(CostInterval(task.interval), task.state, task.drive)
    with torch.no_grad():
        for weight in task.interval.parameters():
            weight += 1.0
    assert_equal(_gradients(found, task.leaves, torch.arange(1.0, 4.0).double()), exact[1:])


def test_a_weight_that_changes_before_the_backward_pass_is_noticed():
    task = Task()
    ends = NATIVE.end_states(task.interval, task.state, task.drive)
    with torch.no_grad():
        next(task.interval.parameters()).add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        ends.sum().backward()


def test_frozen_weights():
    task = Task()
    task.gradients(NATIVE)
    for weight in task.interval.closure.parameters():
        weight.requires_grad_(False)
    assert_equal(task.gradients(NATIVE), task.gradients(AUTOGRAD))
    for weight in task.interval.parameters():
        weight.requires_grad_(False)
    assert_equal(task.gradients(NATIVE), task.gradients(AUTOGRAD))


def test_weights_in_any_memory_layout():
    task = Task(batch=3)
    closure = task.interval.closure
    closure.matrix = nn.Parameter(torch.randn(2, 2, dtype=torch.float64).t())
    assert not closure.matrix.is_contiguous()
    assert_equal(task.gradients(NATIVE), task.gradients(AUTOGRAD))
    closure.matrix = nn.Parameter(torch.randn(4, 4, dtype=torch.float64)[::2, 1::2])
    assert_equal(task.gradients(NATIVE), task.gradients(AUTOGRAD))


def test_shared_weights():
    task = Task(closure="perceptron")
    first, *_, last = (m for m in task.interval.closure.modules() if isinstance(m, nn.Linear))
    task.gradients(NATIVE)
    last.bias = nn.Parameter(first.bias.detach()[:2].clone())
    task.interval.policy.gain = nn.Parameter(torch.randn(1, 2).double())
    task.gradients(NATIVE)
    last.bias = nn.Parameter(task.interval.policy.gain.detach()[0].clone())
    assert_equal(task.gradients(NATIVE), task.gradients(AUTOGRAD))
    task.interval.policy.gain = task.interval.closure.extra = nn.Parameter(torch.randn(1, 2).double())
    assert_equal(task.gradients(NATIVE), task.gradients(AUTOGRAD))


@pytest.mark.parametrize("driver", ["commands", "policy"])
def test_the_own_closure_of_a_plant_keeps_its_weights(driver):
    """The interval holds it twice."""
    task = Task(closure="true", driver=driver)
    before = list(task.interval.parameters())
    assert_equal(task.gradients(NATIVE), task.gradients(AUTOGRAD))
    assert all(a is b for a, b in zip(task.interval.parameters(), before, strict=True))
    assert isinstance(task.plant.closure.matrix, nn.Parameter) and task.plant.closure.matrix.requires_grad


def test_single_precision_is_left_to_torch():
    task = Task()
    task.interval.closure.float()
    with pytest.warns(UserWarning, match="matrix is in torch.float32; trajectories need torch.float64"):
        NATIVE.end_states(task.interval, task.state, task.drive)


class NotBackwards(nn.Module):
    """A closure whose recurrence becomes a program, and whose gradient does not."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(2, dtype=torch.float64))

    def forward(self, features):
        return nn.functional.hardshrink(features * self.weight, 0.1)


def test_where_the_gradient_is_no_program_torch_computes_it():
    task = Task()
    task.interval.closure = NotBackwards()
    with pytest.warns(UserWarning, match="hardshrink_backward"):
        found = task.gradients(NATIVE)
    assert_equal(found, task.gradients(AUTOGRAD))


class Drained(LinearQuadratic):
    """A plant with a Python branch on its state."""

    def vector_field(self, t, state, action, exogenous, closure):
        rates = super().vector_field(t, state, action, exogenous, closure)
        return 3.0 * rates if state[..., 0].sum() > 0.0 else rates


def test_a_python_branch_has_the_gradient_of_the_branch_that_was_taken():
    """Rows of all times at once, as the engine parallel evaluates them, would take one branch for all of them."""
    plant, gradients = Drained(horizon=10.0, noise=0.0), []
    start, inputs = torch.tensor([[1.0, 0.0]]).double(), torch.zeros(1, 100, 1).double()
    for engine in ("native", "autograd"):
        closure = plant.make_closure(seeded(0))
        roll = Rollout(plant, closure, engine=engine)
        with pytest.warns(UserWarning, match="'autograd' takes the place") if engine == "native" else nullcontext():
            flown = roll(start, inputs, torch.zeros(1, 100, 1).double())
        gradients.append(torch.autograd.grad((flown.states**2).mean(), closure.matrix)[0])
    assert flown.states[..., 0].min() < 0.0 < flown.states[..., 0].max()  # both branches are taken
    torch.testing.assert_close(*gradients, rtol=1e-12, atol=0.0)


class Saturated(nn.Module):
    """A policy whose gradient is rounding: 1 − tanh² of about 18 is some units in the last place of one."""

    def __init__(self, bias):
        super().__init__()
        self.weight = nn.Parameter(torch.full((2,), 0.1, dtype=torch.float64))
        self.bias = nn.Parameter(torch.tensor(bias, dtype=torch.float64))

    def forward(self, observation):
        return torch.tanh(self.bias + (observation * self.weight).sum(-1, keepdim=True))


@pytest.mark.parametrize("bias", [17.0, 18.36])
def test_the_rounding_of_a_saturated_policy_is_no_reason_to_refuse_it(bias, monkeypatch):
    monkeypatch.setattr(code, "_kept", OrderedDict())  # policies of the same kind share their programs
    plant, generator = LinearQuadratic(horizon=1.0), torch.Generator().manual_seed(0)
    state, exogenous = plant.draw_initial_state(4, generator), plant.draw_exogenous(4, generator)
    policy = Saturated(bias)
    Rollout(plant, plant.closure, policy).costs(state, exogenous).mean().backward()
    assert policy.weight.grad.abs().max() < 1e-12
