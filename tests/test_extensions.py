"""Plants with dynamics beside their own: against closed forms, and in every part that flies them."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from scipy.linalg import expm
from torch import nn

from rt_torchrl import check_plant
from rt_torchrl.plants.actuators import DelayedActuator, LaggedActuator, ResonantActuator
from rt_torchrl.plants.coefficients import LaggedCoefficients
from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.sensors import BiasedSensor
from rt_torchrl.plants.signal import Signal
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.trajectories.rollout import Rollout

DT = 0.1
EXTENDED = {
    "lag": lambda: LaggedActuator(LinearQuadratic(), "force", 0.4),
    "resonance": lambda: ResonantActuator(LinearQuadratic(), "force", 3.0, 0.4),
    "delay": lambda: DelayedActuator(LinearQuadratic(), "force", 0.3),
    "chain": lambda: LaggedActuator(LinearQuadratic(), "force", 0.3, stages=3),
    "inflow": lambda: LaggedCoefficients(LinearQuadratic(), 0.5, (0.1, -0.2)),
    "bias": lambda: BiasedSensor(LinearQuadratic(), "position", 0.3, 0.02, scale=0.1),
    "nested": lambda: DelayedActuator(ResonantActuator(LinearQuadratic(), "force", 3.0, 0.4), "force", 0.2),
}


def flight(plant, steps=40, batch=2):
    generator = torch.Generator().manual_seed(3)
    state = plant.draw_initial_state(batch, generator)
    exogenous = plant.draw_exogenous(batch, generator)[:, :steps]
    command = 2.0 * torch.rand(batch, steps, 1, generator=generator, dtype=torch.float64) - 1.0
    return state, exogenous, command


def zero_order_hold(A, b, u, x):
    """The state after DT of ẋ = A x + b u."""
    n = len(x)
    joint = torch.zeros(n + 1, n + 1, dtype=torch.float64)
    joint[:n, :n], joint[:n, n] = A, b
    return torch.as_tensor(expm((joint * DT).numpy()))[:n] @ torch.cat([x, u.reshape(1)])


@pytest.mark.parametrize("name", EXTENDED)
def test_an_extended_plant_fulfils_the_contract(name):
    check_plant(EXTENDED[name](), steps=20, traced=False)  # run-time checks of annotations are no part of a graph


@pytest.mark.parametrize("name", EXTENDED)
def test_gradients_by_closure_and_policy_are_those_of_backpropagation(name):
    plant = EXTENDED[name]()
    generator = torch.Generator().manual_seed(1)
    closure, policy = plant.make_closure(generator), plant.make_policy(generator)
    state, exogenous, _ = flight(plant)
    weights = [w for module in (closure, policy) for w in module.parameters()]
    found = [
        torch.autograd.grad(Rollout(plant, closure, policy, engine=engine).costs(state, exogenous).sum(), weights)
        for engine in ("native", "autograd")
    ]
    for native, reference in zip(*found, strict=True):
        torch.testing.assert_close(native, reference, rtol=1e-10, atol=1e-12)
    assert all(gradient.any() for gradient in found[0])


def hidden_of(plant):
    state, exogenous, command = flight(plant)
    return Rollout(plant, plant.closure)(state, exogenous, command).states[0, :, 2:], command[0, :, 0]


@pytest.mark.parametrize(
    "name, A, b",
    [
        ("lag", [[-2.5]], [2.5]),
        ("resonance", [[0.0, 1.0], [-9.0, -2.4]], [0.0, 9.0]),
    ],
)
def test_hidden_states_follow_the_matrix_exponential(name, A, b):
    hidden, command = hidden_of(EXTENDED[name]())
    A, b = torch.tensor(A, dtype=torch.float64), torch.tensor(b, dtype=torch.float64)
    expected = [hidden[0]]
    for u in command:
        expected.append(zero_order_hold(A, b, u, expected[-1]))
    torch.testing.assert_close(hidden, torch.stack(expected), rtol=1e-12, atol=1e-12)


def test_the_mean_of_an_oscillation_is_that_of_a_fine_quadrature():
    plant = EXTENDED["resonance"]()
    x = torch.tensor([0.5, -1.0], dtype=torch.float64)
    asked = torch.tensor([0.8], dtype=torch.float64)
    mean, _ = plant.respond(x, asked, plant.closure)
    fine = ResonantActuator(LinearQuadratic(dt=DT / 1000), "force", 3.0, 0.4)
    positions = [x]
    for _ in range(1000):
        positions.append(fine.respond(positions[-1], asked, fine.closure)[1])
    torch.testing.assert_close(mean[0], torch.trapezoid(torch.stack(positions)[:, 0]) / 1000, rtol=1e-6, atol=0.0)


def test_a_delay_gives_what_was_asked_for_earlier():
    plant = EXTENDED["delay"]()
    state, exogenous, command = flight(plant)
    flown = Rollout(plant, plant.closure)(state, exogenous, command)
    late = torch.cat([torch.zeros_like(command[:, :3]), command[:, :-3]], 1)
    base = LinearQuadratic()
    expected = Rollout(base, base.closure)(state[:, :2], exogenous, late)
    torch.testing.assert_close(flown.states[..., :2], expected.states, rtol=1e-12, atol=1e-12)
    assert torch.equal(flown.actions, command)  # the actuators believe that they did what they were asked for


def test_the_response_of_a_chain_has_its_mean_delay():
    plant = LaggedActuator(LinearQuadratic(dt=0.01), "force", 0.3, stages=5)
    x, step = torch.zeros(5, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    missing = 0.0
    for _ in range(500):
        mean, x = plant.respond(x, step, plant.closure)
        missing += (1.0 - mean.item()) * 0.01
    assert missing == pytest.approx(0.3, rel=1e-6)


@pytest.mark.parametrize(
    "extend",
    [
        lambda base: LaggedActuator(base, "force", 1e-7),
        lambda base: LaggedActuator(base, "force", 1e-7, stages=6),
        lambda base: LaggedCoefficients(base, 1e-7, (0.0, 0.0)),
        lambda base: BiasedSensor(base, "position", 0.0, scale=1.0),
    ],
)
def test_an_extension_without_effect_is_the_plant(extend):
    base = LinearQuadratic()
    plant = extend(base)
    state, exogenous, command = flight(plant)
    expected = Rollout(base, base.closure)(state[:, :2], exogenous, command).states
    torch.testing.assert_close(
        Rollout(plant, plant.closure)(state, exogenous, command).states[..., :2], expected, rtol=1e-5, atol=1e-5
    )


def test_the_inflow_of_a_constant_force_rises_exponentially():
    plant = EXTENDED["inflow"]()

    class Constant(nn.Module):
        def forward(self, features):
            return torch.ones_like(features)

    state, exogenous, command = flight(plant)
    closure = plant.extended(Constant())
    hidden = Rollout(plant, closure)(state, exogenous, command).states[0, :, 2]
    t = DT * torch.arange(41, dtype=torch.float64)
    torch.testing.assert_close(hidden, 1.0 + (0.1 - 1.0) * torch.exp(-t / 0.5), rtol=1e-12, atol=1e-12)


class Bounded(LinearQuadratic):
    """Ends half a metre from its set point, which it shows."""

    end_cost = 100.0

    def ended(self, state):
        return state[..., 0].abs() > 0.5

    def setpoints(self, states, applied, exogenous):
        return {"x": (states[..., 0], torch.zeros_like(states[..., 0]))}


def test_an_episode_ends_and_is_shown_by_the_true_state_and_not_by_the_reading():
    plant = BiasedSensor(Bounded(), "position", 1.0, scale=1.0)
    reads = torch.tensor([[1.2, 0.0, 1.0], [0.2, 0.0, 1.0]]).double()  # the true positions are 0.2 and -0.8
    assert plant.ended(reads).tolist() == [False, True]
    value, _ = plant.setpoints(reads, torch.zeros(2, 1).double(), torch.zeros(2, 1).double())["x"]
    assert value.tolist() == pytest.approx([0.2, -0.8])


def test_a_biased_sensor_changes_what_is_read_and_not_what_happens():
    plant, base = EXTENDED["bias"](), LinearQuadratic()
    state, exogenous, command = flight(plant)
    bias = 0.3 + 0.02 * DT * torch.arange(41, dtype=torch.float64)
    flown = Rollout(plant, plant.closure)(state, exogenous, command)
    true = state[:, :2] - torch.tensor([0.3, 0.0], dtype=torch.float64)
    expected = Rollout(base, base.closure)(true, exogenous, command)
    torch.testing.assert_close(flown.states[..., 0], expected.states[..., 0] + bias, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(flown.states[..., 1], expected.states[..., 1], rtol=1e-12, atol=1e-12)
    costs = Rollout(plant, plant.closure).costs(state, exogenous, command)
    torch.testing.assert_close(costs, Rollout(base, base.closure).costs(true, exogenous, command))


def test_an_environment_hides_what_no_sensor_reads():
    plant = EXTENDED["nested"]()
    env = PlantEnv(plant)
    assert env.reset()["state"].shape == (1, 2)
    assert env.rollout(3)["next", "state"].shape == (1, 3, 2)
    assert [signal.name for signal in plant.readings] == ["position", "velocity"]


class Stepping(LinearQuadratic):
    def step(self, t, state, command, exogenous, closure):
        return super().step(t, state, command, exogenous, closure)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: LaggedActuator(LinearQuadratic(), "torque", 1.0), r"action='torque'.*force"),
        (lambda: LaggedActuator(LinearQuadratic(), "force", 0.0), r"\[0.0\].* must be force_lag \[s\], positive"),
        (lambda: LaggedActuator(Stepping(), "force", 1.0), r"overrides step\(\)"),
        (lambda: LaggedActuator(EXTENDED["lag"](), "force", 1.0), r"already has the states lagged_force"),
        (lambda: ResonantActuator(LinearQuadratic(), "force", 1.0, 1.0), r"damping=1.0.*\(0, 1\)"),
        (lambda: DelayedActuator(LinearQuadratic(), "force", 0.25), r"1 to 64 control intervals of 0.1 s"),
        (lambda: LaggedActuator(LinearQuadratic(), "force", 0.3, stages=0), r"stages=0"),
        (lambda: LaggedCoefficients(EXTENDED["lag"](), 1.0, (0.0,)), r"closure of the plant itself"),
        (lambda: BiasedSensor(LinearQuadratic(), "height", 1.0, scale=1.0), r"state='height'.*position, velocity"),
        (lambda: BiasedSensor(LinearQuadratic(), "position", 1.0, scale=0.0), r"scale=0.0 must be positive"),
    ],
)
def test_what_cannot_be_extended_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_hidden_states_need_a_start():
    class Startless(Extension):
        pass

    with pytest.raises(TypeError, match=r"Startless has hidden states.*rest\(\)"):
        Startless(LinearQuadratic(), [Signal(symbol="x", name="hidden", unit="-")])
    assert Startless(LinearQuadratic(), []).at_rest(torch.ones(1, 2).double()).tolist() == [[1.0, 1.0]]
