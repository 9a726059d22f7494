"""What every plant fulfils: each folder under rt_torchrl.envs, found by itself, and the linear-quadratic oracle."""

import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from linear_quadratic import LinearQuadratic
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import check_env_specs

from rt_torchrl.catalogue import plants
from rt_torchrl.environment import PlantEnv
from rt_torchrl.trajectory import Rollout, control_cost
from rt_torchrl.twin import DigitalTwin

CLASSES = {"linear_quadratic": LinearQuadratic} | plants()
GREATEST_EPISODE = 2000


def shortened(kind, steps):
    """A plant whose episode has at most so many steps."""
    plant = kind()
    return plant if plant.n_steps <= steps else kind(dt=plant.dt, horizon=steps * plant.dt)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(params=CLASSES)
def kind(request):
    return CLASSES[request.param]


@pytest.fixture
def plant(kind):
    """With a short episode, where its length is not the matter."""
    return shortened(kind, 50)


def visited(plant, count, seed=1):
    """Arguments of the vector field met on real episodes under random commands: t, state, applied action, input."""
    generator = seeded(seed)
    state, exogenous = plant.draw_initial_state(count, generator), plant.draw_exogenous(count, generator)
    low, high = action_range(plant)
    share = torch.rand(count, plant.n_steps, len(plant.actions), generator=generator, dtype=torch.float64)
    with torch.no_grad():
        flown = Rollout(plant, plant.closure)(state, exogenous, low + share * (high - low))
    at = torch.arange(count) % plant.n_steps
    rows = torch.arange(count)
    return at * plant.dt, flown.states[rows, at], flown.actions[rows, at], exogenous[rows, at]


def action_range(plant):
    return (torch.tensor([getattr(a, b) for a in plant.actions], dtype=torch.float64) for b in ("low", "high"))


def fly(plant, *, batch=1, seed=0):
    """A real episode under the plant's initial policy, with the policy."""
    policy = plant.make_policy(seeded(5))
    env = PlantEnv(plant, batch_size=batch, seed=seed)
    with torch.no_grad():
        episode = env.rollout(
            plant.n_steps + 10, TensorDictModule(policy, in_keys=["observation"], out_keys=["action"])
        )
    return episode, policy


def test_plants_are_found():
    assert "wind_turbine" in CLASSES


def test_signals_are_named_and_fit_the_draws(kind, plant):
    assert plant.name == next(name for name, found in CLASSES.items() if found is kind)
    for group in (plant.states, plant.actions, plant.inputs, plant.observations):
        assert group and len({signal.name for signal in group}) == len(group)
        assert all(signal.unit and signal.symbol and signal.unit in signal.label for signal in group)
    assert all(math.isfinite(a.low) and math.isfinite(a.high) for a in plant.actions)
    state, exogenous = plant.draw_initial_state(3, seeded()), plant.draw_exogenous(3, seeded())
    assert state.shape == (3, len(plant.states)) and exogenous.shape == (3, plant.n_steps, len(plant.inputs))
    for drawn, signals in ((state, plant.states), (exogenous, plant.inputs)):
        assert drawn.dtype == torch.float64
        low, high = (torch.tensor([getattr(s, b) for s in signals], dtype=torch.float64) for b in ("low", "high"))
        assert ((drawn >= low) & (drawn <= high)).all()
    assert plant.observe(torch.zeros(3).double(), state, exogenous[:, 0]).shape == (3, len(plant.observations))


def test_default_episode_is_a_whole_number_of_steps(kind):
    plant = kind()
    assert plant.n_steps == round(plant.horizon / plant.dt)
    for change in ({"dt": 0.0}, {"horizon": -1.0}, {"horizon": plant.horizon + 0.37 * plant.dt}):
        with pytest.raises(ValueError, match=f"{next(iter(change))}="):
            kind(**{"dt": plant.dt, "horizon": plant.horizon, **change})


def test_randomness_comes_from_the_generator_alone(plant):
    def draws(seed):
        policy, closure = plant.make_policy(seeded(seed)), plant.make_closure(seeded(seed))
        tensors = [plant.draw_initial_state(2, seeded(seed)), plant.draw_exogenous(2, seeded(seed))]
        return tensors + [*policy.parameters(), *closure.parameters()]

    first = draws(1)
    torch.manual_seed(99)
    assert all(torch.equal(a, b) for a, b in zip(first, draws(1), strict=True))
    other = draws(2)
    # A problem may fix its start, and a closure its first coefficients; inputs and the policy are drawn.
    assert not any(torch.equal(a, b) for a, b in zip(first[1:3], other[1:3], strict=True))
    assert not torch.equal(first[1][0], first[1][1])


def test_vector_field_takes_any_leading_dimensions(plant):
    t, state, action, exogenous = visited(plant, 6)
    closure = plant.make_closure(seeded())
    shapes = [x.reshape(2, 3, *x.shape[1:]) for x in (t, state, action, exogenous)]
    together = plant.vector_field(*shapes, closure)
    costs = plant.running_cost(*shapes)
    assert together.shape == (2, 3, len(plant.states)) and costs.shape == (2, 3)
    for k in range(6):
        row = (t[k], state[k], action[k], exogenous[k])
        # The same arithmetic; vector instructions may round a power or an exponential in the last bits.
        torch.testing.assert_close(together[k // 3, k % 3], plant.vector_field(*row, closure), rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(costs[k // 3, k % 3], plant.running_cost(*row), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("which", ["true", "learned"])
def test_vector_field_is_differentiable(plant, which):
    """gradcheck in units of each argument's size, at states that episodes visit, by both modes of differentiation."""
    closure = plant.closure if which == "true" else plant.make_closure(seeded())
    t, *arguments = visited(plant, 4)
    scales = [1.0 + x.abs().amax(0) for x in arguments]
    rates = plant.vector_field(t, *arguments, closure)
    assert rates.isfinite().all()
    size = 1e-3 + rates.abs().amax(0).detach()

    def scaled(*values):
        return plant.vector_field(t, *(x * s for x, s in zip(values, scales, strict=True)), closure) / size

    inputs = [(x / s).detach().requires_grad_() for x, s in zip(arguments, scales, strict=True)]
    # Differences of numbers of order one with a step of 1e-6: rounding 1e-10, curvature 1e-12.
    assert torch.autograd.gradcheck(scaled, inputs, eps=1e-6, atol=1e-6, rtol=1e-6, check_forward_ad=True)


def test_closure_reaches_the_state(plant):
    """Every weight of the learned closure changes the vector field somewhere."""
    closure = plant.make_closure(seeded())
    t, *arguments = visited(plant, 16)
    rates = plant.vector_field(t, *arguments, closure)
    scale = 1e-3 + rates.detach().abs().amax(0)
    gradients = torch.autograd.grad((rates / scale).square().sum(), list(closure.parameters()))
    assert all((gradient != 0).all() for gradient in gradients)


def test_policy_acts_within_the_ranges(plant):
    policy, (low, high) = plant.make_policy(seeded()), action_range(plant)
    # Observations are scaled to order one.
    command = policy(3.0 * torch.rand(200, len(plant.observations), generator=seeded(), dtype=torch.float64) - 1.5)
    assert command.shape == (200, len(plant.actions))
    assert ((command >= low) & (command <= high)).all()


def test_twin_with_the_true_closure_is_the_real_system(kind, unchecked):
    plant = shortened(kind, GREATEST_EPISODE)
    episode, policy = fly(plant)
    twin = DigitalTwin(plant, plant.closure)
    exogenous, states = episode["exogenous"], torch.cat([episode["state"], episode["next", "state"][:, -1:]], 1)
    scale = states.abs().amax((0, 1))
    with torch.no_grad():
        flights = {
            "commands": twin.replay(states[:, 0], exogenous, episode["action"]),
            "applied actions": twin.replay(states[:, 0], exogenous, episode["next", "applied"]),
            "policy": twin.control(policy, states[:, 0], exogenous),
        }
        for name, flown in flights.items():
            # The same operations on other batch shapes: rounding, damped by stable plants.
            assert ((flown.states - states).abs() / scale).max() < 1e-12, name
            torch.testing.assert_close(flown.actions, episode["next", "applied"], rtol=1e-12, atol=1e-12)
        cost = control_cost(plant, flights["policy"], exogenous)
    torch.testing.assert_close(cost, -episode["next", "reward"][..., 0].mean(-1), rtol=1e-12, atol=0)


def test_reward_is_minus_the_running_cost(plant):
    episode, _ = fly(plant, batch=3)
    t = plant.dt * torch.arange(plant.n_steps, dtype=torch.float64)
    cost = plant.running_cost(t, episode["state"], episode["next", "applied"], episode["exogenous"])
    torch.testing.assert_close(episode["next", "reward"][..., 0], -cost, rtol=1e-12, atol=1e-15)  # rounding
    assert (cost >= 0).all()


def test_environment_fulfils_its_specs(plant):
    check_env_specs(PlantEnv(plant, batch_size=2, seed=3), seed=3)


def test_episode_is_truncated_at_the_horizon_and_never_terminated(plant):
    episode, _ = fly(plant, batch=2)
    assert episode.shape == (2, plant.n_steps)
    last = torch.zeros(2, plant.n_steps, 1, dtype=torch.bool)
    last[:, -1] = True
    assert torch.equal(episode["next", "truncated"], last) and torch.equal(episode["next", "done"], last)
    assert not episode["next", "terminated"].any()


def test_environment_is_seeded(plant):
    flights = [fly(plant, seed=seed)[0]["next", "state"] for seed in (7, 7, 8)]
    assert torch.equal(flights[0], flights[1]) and not torch.equal(flights[0], flights[2])


TRACE = """
import sys
sys.path.insert(0, "tests")
import torch
from test_plant_contract import CLASSES, seeded, shortened, visited

for name, kind in CLASSES.items():
    plant = shortened(kind, 50)
    arguments = visited(plant, 4)
    closure = plant.make_closure(seeded())
    def everything(t, state, action, exogenous):
        rates = plant.vector_field(t, state, action, exogenous, plant.closure)
        end, applied = plant.step(t, state, action, exogenous, closure)
        return end, applied, rates, plant.running_cost(t, state, applied, exogenous), plant.observe(t, end, exogenous)

    try:
        traced = torch.compile(everything, fullgraph=True, backend="eager")
        for found, expected in zip(traced(*arguments), everything(*arguments), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-13, atol=1e-13)
        print("traced", name)
    except Exception as error:
        print(name, error, file=sys.stderr)
"""


@pytest.fixture(scope="module")
def tracing():
    """In a process of its own: the run-time checks of this one cannot be traced."""
    root = Path(__file__).parent.parent
    return subprocess.run([sys.executable, "-c", TRACE], cwd=root, capture_output=True, text=True)


def test_is_one_graph_without_branches_on_tensors(plant, tracing):
    assert f"traced {plant.name}\n" in tracing.stdout, tracing.stderr[-3000:]
