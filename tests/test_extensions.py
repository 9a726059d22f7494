"""Plants with dynamics beside their own: against closed forms, and in every part that flies them."""

import math

import pytest
import torch
from linear_quadratic import LinearQuadratic
from scipy.linalg import expm
from seeds_and_numbers import seeded
from torch import nn

import rt_torchrl as rt
from rt_torchrl.contract.methods import random_commands
from rt_torchrl.plants.plant import PARTS

DT = 0.1


def residual(base):
    """The plant with a network that is no longer zero."""
    plant = rt.NeuralResidual(base, {"velocity": 1.0}, inputs=("force",))
    with torch.no_grad():
        for weight in plant.closure.own.parameters():
            weight.copy_(torch.randn(weight.shape, generator=seeded(), dtype=weight.dtype))
    return plant


EXTENSIONS = {
    "lag": lambda base: rt.LaggedActuator(base, "force", 0.4),
    "chain": lambda base: rt.LaggedActuator(base, "force", 0.3, stages=3),
    "resonance": lambda base: rt.ResonantActuator(base, "force", 3.0, 0.4),
    "delay": lambda base: rt.DelayedActuator(base, "force", 0.3),
    "scaled": lambda base: rt.ScaledActuator(base, "force", 0.8),
    "rate": lambda base: rt.RateLimitedActuator(base, "force", 0.5),
    "play": lambda base: rt.PlayActuator(base, "force", 0.02),
    "stiction": lambda base: rt.StickingActuator(base, "force", 0.02),
    "share": lambda base: rt.ScaledCoefficients(base, 0.9),
    "bias": lambda base: rt.BiasedSensor(base, "position", 0.3, 0.02, scale=0.1),
    "residual": residual,
    "stacked": lambda base: rt.StackedObservations(base, 2),
    "delayed resonance": lambda base: rt.DelayedActuator(rt.ResonantActuator(base, "force", 3.0, 0.4), "force", 0.2),
    "biased delay": lambda base: rt.BiasedSensor(rt.DelayedActuator(base, "force", 0.3), "position", 0.3, scale=0.1),
    "delayed bias": lambda base: rt.DelayedActuator(rt.BiasedSensor(base, "position", 0.3, scale=0.1), "force", 0.3),
    "residual around a lag": lambda base: residual(rt.LaggedActuator(base, "force", 0.4)),
    "lag around a residual": lambda base: rt.LaggedActuator(residual(base), "force", 0.4),
    "lag of the stacked": lambda base: rt.LaggedActuator(rt.StackedObservations(base, 2), "force", 0.4),
}
"""Every extension of the oracle plant, and those of which one changes what the other needs."""


def flight(plant, steps=40, batch=2):
    """Initial states, inputs, and commands within the ranges of the actions."""
    generator = seeded(3)
    state, exogenous = plant.draw_initial_state(batch, generator), plant.draw_exogenous(batch, generator)
    return state, exogenous[:, :steps], random_commands(plant, (batch, steps), generator)


def zero_order_hold(A, b, u, x):
    """The state after DT of ẋ = A x + b u, and its mean over DT."""
    n = len(x)
    joint = torch.zeros(2 * n + 1, 2 * n + 1, dtype=torch.float64)
    joint[:n, :n], joint[:n, -1], joint[n:-1, :n] = A, b, torch.eye(n)
    found = torch.as_tensor(expm((joint * DT).numpy())) @ torch.cat([x, torch.zeros(n), u.reshape(1)])
    return found[:n], found[n:-1] / DT


@pytest.mark.parametrize("name", EXTENSIONS)
def test_an_extended_plant_fulfils_the_contract(name):
    rt.check_plant(EXTENSIONS[name](LinearQuadratic()), steps=20)


@pytest.mark.parametrize("name", EXTENSIONS)
def test_gradients_by_closure_and_policy_are_those_of_backpropagation(name):
    plant = EXTENSIONS[name](LinearQuadratic())
    generator = torch.Generator().manual_seed(1)
    closure, policy = plant.make_closure(generator), plant.make_policy(generator)
    state, exogenous, _ = flight(plant)
    weights = [w for module in (closure, policy) for w in module.parameters()]
    engines = ("autograd", "native", "parallel") if "residual" in name else ("autograd", "native")
    reference, *others = (
        torch.autograd.grad(rt.Rollout(plant, closure, policy, engine=engine).costs(state, exogenous).sum(), weights)
        for engine in engines
    )
    for found in others:
        for gradient, expected in zip(found, reference, strict=True):
            torch.testing.assert_close(gradient, expected, rtol=1e-10, atol=1e-12)
    assert all(gradient.any() for gradient in reference)


@pytest.mark.parametrize(
    "name, A, b", [("lag", [[-2.5]], [2.5]), ("resonance", [[0.0, 1.0], [-9.0, -2.4]], [0.0, 9.0])]
)
def test_an_actuator_follows_the_matrix_exponential_and_its_mean_acts(name, A, b):
    plant = EXTENSIONS[name](LinearQuadratic())
    A, b = torch.tensor(A, dtype=torch.float64), torch.tensor(b, dtype=torch.float64)
    hidden = torch.linspace(-0.3, 0.4, len(b)).double()
    for u in flight(plant)[2][0]:
        end, mean = zero_order_hold(A, b, u, hidden)
        acting, hidden = plant.respond(hidden, u, plant.closure)
        torch.testing.assert_close(hidden, end, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(acting, mean[:1], rtol=1e-12, atol=1e-12)


def test_a_delay_gives_what_was_asked_for_earlier():
    plant = EXTENSIONS["delay"](LinearQuadratic())
    state, exogenous, command = flight(plant)
    flown = rt.Rollout(plant, plant.closure)(state, exogenous, command)
    late = torch.cat([torch.zeros_like(command[:, :3]), command[:, :-3]], 1)
    base = LinearQuadratic()
    expected = rt.Rollout(base, base.closure)(state[:, :2], exogenous, late)
    torch.testing.assert_close(flown.states[..., :2], expected.states, rtol=1e-12, atol=1e-12)
    assert torch.equal(flown.actions, command)  # the actuators believe that they did what they were asked for


def test_a_coefficient_stays_within_its_factor_whatever_the_weight():
    own = rt.PositiveCoefficients([2.0], names={"lag": "s"}, factor=10.0)
    for weight, expected in ((0.0, 2.0), (0.5, 2.0 * 10.0 ** math.tanh(0.5)), (50.0, 20.0), (-50.0, 0.2)):
        own.weights.data.fill_(weight)
        assert own.named_coefficients()["lag"].item() == pytest.approx(expected)


def test_a_biased_sensor_changes_what_is_read_and_not_what_happens():
    plant, base = EXTENSIONS["bias"](LinearQuadratic()), LinearQuadratic()
    state, exogenous, command = flight(plant)
    bias = 0.3 + 0.02 * DT * torch.arange(41, dtype=torch.float64)
    flown = rt.Rollout(plant, plant.closure)(state, exogenous, command)
    true = state[:, :2] - torch.tensor([0.3, 0.0], dtype=torch.float64)
    expected = rt.Rollout(base, base.closure)(true, exogenous, command)
    torch.testing.assert_close(flown.states[..., 0], expected.states[..., 0] + bias, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(flown.states[..., 1], expected.states[..., 1], rtol=1e-12, atol=1e-12)
    costs = rt.Rollout(plant, plant.closure).costs(state, exogenous, command)
    torch.testing.assert_close(costs, rt.Rollout(base, base.closure).costs(true, exogenous, command))


class Particular(LinearQuadratic):
    """Overrides every method that an extension asks of its plant, so that none can be the default by chance."""

    name, end_cost = "particular", 50.0
    discrepancy_scales = (0.5, 2.0)
    moments = torch.zeros(1, dtype=torch.float64)

    def observe(self, t, state, exogenous):
        return 2.0 * state + torch.sin(t).unsqueeze(-1) + exogenous

    def actuate(self, state, command):
        return 0.5 * command + 0.1 * state[..., 1:]

    def memorise(self, t, state, exogenous):
        return 0.9 * state + 0.01 * exogenous + t.unsqueeze(-1)

    def latch(self, state, applied):
        return 1.1 * state + applied

    def running_cost(self, t, state, applied, exogenous):
        return state[..., 0] ** 2 + 3.0 * applied[..., 0] + exogenous[..., 0] + t

    def terminal_cost(self, state):
        return state[..., 0] + 4.0

    def ended(self, state):
        return state[..., 0] > 0.2

    def merit(self, states, applied, exogenous):
        return {"spread [m]": states[..., 0].amax(-1), "work [J]": (states[:, :-1, 1] * applied[..., 0]).sum(-1)}

    def setpoints(self, states, applied, exogenous):
        return {"x [m]": (states[..., 0] * applied[..., 0], exogenous[..., 0])}

    def complete_states(self, measured, exogenous, actions):
        return torch.stack([measured["position"], measured["position"] + 1.0], -1)

    def controller_start(self, measured, exogenous):
        return measured + exogenous

    def at_rest(self, read):
        return read + 0.5

    def draw_initial_state(self, batch, generator):
        return 3.0 + torch.rand(batch, 2, generator=generator, dtype=torch.float64)

    def draw_exogenous(self, batch, generator):
        return super().draw_exogenous(batch, generator) + 2.0

    def make_closure(self, generator):
        return nn.Identity()

    def make_neural_closure(self, generator, hidden):
        return nn.Linear(2, hidden[0], dtype=torch.float64)

    def make_policy(self, generator):
        return nn.Linear(2, 1, dtype=torch.float64)


@pytest.mark.parametrize("kind", EXTENSIONS)
def test_whatever_a_plant_overrides_holds_under_every_extension(kind):
    """The parts of a state and of an action are taken by hand here; the plant must answer as if it was not extended."""
    plant = EXTENSIONS[kind](Particular(horizon=1.0))
    base, n = plant.base, 10
    states = torch.randn(3, n + 1, len(plant.states), generator=seeded(1)).double()
    states[..., 2:] *= 0.1
    a, z = torch.randn(3, n, 1, generator=seeded(2)).double(), torch.ones(3, n, 1).double()
    s, first = states[:, :-1], states[:, 0, : len(plant.readings)]
    (read, hidden), true, half, t = plant.split(s), plant.true_state(s), 0.5 * s, DT * torch.arange(n).double()
    acting, log = plant.acting(hidden, a), {"position": states[0, :, 0], "velocity": states[0, :, 1]}
    measured, begun = read[:, 0, :2], z[:, 0]

    def of_plant(extended):
        """The part of a state that is the plant's own."""
        return plant.split(extended)[0]

    answers = {
        "observe": (plant.observe(t, s, z)[..., :2], base.observe(t, read, z)[..., :2]),
        "actuate": (plant.actuate(s, a), base.actuate(read, a)),
        "memorise": (of_plant(plant.memorise(t, s, z)), base.memorise(t, read, z)),
        "latch": (plant.latch(s, a), plant.joined(base.latch(read, a), hidden)),
        "running_cost": (plant.running_cost(t, s, a, z), base.running_cost(t, true, acting, z)),
        "terminal_cost": (plant.terminal_cost(s), base.terminal_cost(true)),
        "ended": (plant.ended(s), base.ended(true)),
        "merit": (plant.merit(states, a, z), base.merit(plant.true_state(states), acting, z)),
        "setpoints": (plant.setpoints(s, a, z), base.setpoints(true, acting, z)),
        "discrepancy": (plant.discrepancy(s, half), base.discrepancy(read, of_plant(half))),
        "complete_states": (of_plant(plant.complete_states(log, z[0], a[0])), base.complete_states(log, z[0], a[0])),
        "controller_start": (
            plant.controller_start(measured, begun)[..., :2],
            base.controller_start(measured, begun)[..., :2],
        ),
        "at_rest": (of_plant(plant.at_rest(first)), base.at_rest(first[:, : len(base.readings)])),
        "draw_initial_state": (
            plant.true_state(plant.draw_initial_state(3, seeded())),
            base.draw_initial_state(3, seeded()),
        ),
        "draw_exogenous": (plant.draw_exogenous(3, seeded(3)), base.draw_exogenous(3, seeded(3))),
    }
    for name, (answer, expected) in answers.items():
        torch.testing.assert_close(answer, expected, rtol=1e-14, atol=1e-14, msg=name)
    assert plant.readings[:2] == LinearQuadratic.states and plant.end_cost == 50.0
    bare = plant.make_closure(seeded()), plant.make_neural_closure(seeded(), (2,))
    for closure, kind_of_closure in zip(bare, (nn.Identity, nn.Linear), strict=True):
        while isinstance(closure, rt.ExtendedClosure):
            closure = closure.base
        assert isinstance(closure, kind_of_closure)
    assert "stacked" in kind or isinstance(plant.make_policy(seeded()), nn.Linear)
    asked = {method for methods in PARTS.values() for method in methods}
    assert asked == (answers.keys() | {"make_closure", "make_neural_closure", "make_policy"}) - {"discrepancy"}


def test_what_a_plant_and_an_extension_must_have_and_take():
    signals = dict.fromkeys(("states", "actions", "inputs", "observations"), ())
    parts = {"name": "half", "vector_field": LinearQuadratic.vector_field, **signals}
    with pytest.raises(TypeError, match="Half must define running_cost, draw_initial_state, draw_exogenous, make_cl"):
        type("Half", (rt.Plant,), parts)(dt=0.1, horizon=1.0, closure=nn.Identity())
    with pytest.raises(TypeError, match="unexpected keyword argument 'bias'"):
        EXTENSIONS["lag"](LinearQuadratic()).make_policy(seeded(), bias=True)  # an argument of the plant alone
    Startless = type("Startless", (rt.Extension,), {})
    with pytest.raises(TypeError, match=r"Startless has hidden states.*rest\(\)"):
        Startless(LinearQuadratic(), [rt.Signal(symbol="x", name="hidden", unit="-")])
    assert Startless(LinearQuadratic(), []).at_rest(torch.ones(1, 2).double()).tolist() == [[1.0, 1.0]]


@pytest.mark.parametrize(
    ("kind", "size", "asked", "means", "ends"),
    [
        # At 2/s an interval of 0.1 s moves by 0.2; 0.1 is reached at half of the second interval.
        (rt.RateLimitedActuator, 2.0, [0.3, 0.3, 0.3, -1.0], [0.1, 0.275, 0.3, 0.2], [0.2, 0.3, 0.3, 0.1]),
        (rt.PlayActuator, 0.5, [0.4, 1.0, 0.6, -0.8, -0.2], [0.0, 0.5, 0.5, -0.3, -0.3], [0.0, 0.5, 0.5, -0.3, -0.3]),
        (rt.StickingActuator, 0.5, [0.4, 0.6, 0.2, 0.0], [0.0, 0.6, 0.6, 0.0], [0.0, 0.6, 0.6, 0.0]),
    ],
)
def test_motions_by_hand(kind, size, asked, means, ends):
    """What acts on the plant in each interval, and where the actuator is at its end."""
    plant = kind(LinearQuadratic(dt=0.1), "force", size)
    position, found = torch.zeros(1).double(), []
    for action in asked:
        acting, position = plant.respond(position, torch.tensor([action]).double(), plant.closure)
        found.append((acting.item(), position.item()))
    assert [mean for mean, _ in found] == pytest.approx(means) and [end for _, end in found] == pytest.approx(ends)
