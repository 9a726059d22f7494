"""Controller and twin in C: in closed loop against the plant, torch and exact filters; what is refused."""

import ctypes
import math

import pytest
import torch
from c_build import library, needs_compiler
from linear_quadratic import LinearGain, LinearQuadratic
from seeds_and_numbers import double, seeded, stepped

import rt_torchrl as rt
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.export.c_controller import Controller
from rt_torchrl.export.c_file import c_array
from rt_torchrl.programs.c_source import CSource

CLOSE = 1e-9


class InC:
    """A controller in C, compiled and called without this library's loader."""

    def __init__(self, path, n_actions, n_memory, n_signals):
        loaded = library(path)
        self.init, self.advance = (getattr(loaded, f"{path.stem}_{part}") for part in ("init", "step"))
        sizes = {"command": n_actions, "memory": n_memory, "last": n_signals}
        fields = [("steps", ctypes.c_ulonglong), *((name, ctypes.c_double * n) for name, n in sizes.items())]
        self.state = type("State", (ctypes.Structure,), {"_fields_": fields})()
        self.action = (ctypes.c_double * n_actions)()

    def start(self, *signals):
        self.init(ctypes.byref(self.state), c_array(signals))

    def step(self, *signals):
        self.advance(ctypes.byref(self.state), c_array(signals), self.action)
        return list(self.action)


def law(plant):
    """A policy that holds the turbine near its reference, so that speed and wind move all filters."""
    policy = rt.SaturatedAffine(len(plant.observations), plant.actions, generator=seeded(3))
    with torch.no_grad():
        policy.linear.weight[:] = 0.0
        policy.linear.weight[:, :2] = torch.tensor([[1.0, 0.4], [0.6, 0.3]], dtype=torch.float64)
        policy.linear.bias.copy_(torch.tensor([0.5, -1.0], dtype=torch.float64))
    return policy


@needs_compiler
@pytest.mark.parametrize(
    "observe", ["paper", *(pytest.param(s, marks=pytest.mark.slow) for s in ("scheduled", "measured+wind"))]
)
def test_a_turbine_flies_an_episode_by_its_controller_in_c(observe, tmp_path, monkeypatch):
    """Rotor speed and wind go in; the loops of C and of torch are closed one by one."""
    monkeypatch.setattr("rt_torchrl.export.c_controller.INTERVALS", 50)
    plant = WindTurbine(observe=(observe,), horizon=150.0)
    policy = law(plant)
    assert rt.export_controller(policy, tmp_path / "turbine.c", plant, name="turbine") < CLOSE
    start, exogenous = plant.draw_initial_state(1, seeded(1)), plant.draw_exogenous(1, seeded(2))
    in_c = InC(tmp_path / "turbine.c", 2, len(plant.states) - 1, 2)
    in_c.start(start[0, 0].item(), exogenous[0, 0, 0].item())
    in_c.state.memory[:] = start[0, 1:].tolist()

    def by_c(k, t, state, z):
        return torch.tensor([in_c.step(state[0, 0].item(), z.item())], dtype=torch.float64)

    controller, held = Controller(plant, policy), {}

    def by_torch(k, t, state, z):
        t, speed, memory = t[None], state[:, :1], start[:, 1:]
        if k:
            memory = controller.advance(t - plant.dt, *held["before"], speed)
        command, _ = controller.act(t, memory, speed, z)
        held["before"] = (memory, speed, z, command)
        return command

    (states,), (actions,), _ = stepped(plant, plant.closure, start, exogenous, by_c)
    assert len(actions) == 300 and actions.std(0).min() > 0.0
    expected = stepped(plant, plant.closure, start, exogenous, by_torch)[0][0]
    size = expected.abs().amax(0)
    assert ((states - expected).abs() / size).max() < CLOSE
    # The memory of the actuators is that of the plant; the filters differ by the curvature of the speed in an interval.
    found = torch.tensor(list(in_c.state.memory), dtype=torch.float64)
    torch.testing.assert_close(found[3:5], states[-2, 4:6], rtol=CLOSE, atol=CLOSE)
    ideal = rt.Rollout(plant, plant.closure, policy, engine="autograd")(start, exogenous).states[0].detach()
    assert 1e-9 < ((states - ideal).abs() / size).max() < 2e-3


@needs_compiler
def test_a_controller_of_an_extended_plant_with_parameters(tmp_path):
    """The lag is the machine's and no part of the controller, which holds the last two observations."""
    plant = rt.StackedObservations(rt.LaggedActuator(LinearQuadratic(), "force", 0.3), 2)
    policy = LinearGain([[1.0, 0.6, -0.3, 0.2, 0.1, -0.4]])
    assert rt.export_controller(policy, tmp_path / "stacked.c", plant, name="stacked") < CLOSE
    in_c = InC(tmp_path / "stacked.c", 1, 4, 2)
    start, exogenous = plant.draw_initial_state(1, seeded(1)), plant.draw_exogenous(1, seeded(2))
    in_c.start(*start[0, :2].tolist())

    def by_c(k, t, state, z):
        return double(in_c.step(*state[0, :2].tolist()))

    states, actions, _ = stepped(plant, plant.closure, start, exogenous, by_c)
    past, expected = [start[:, :2]] * 2, list[torch.Tensor]()
    for state in states[0, :-1, None, :2]:
        expected.append(policy(torch.cat([state, *past], -1))[0])
        past = [state, past[0]]
    torch.testing.assert_close(actions[0], torch.stack(expected), rtol=0, atol=1e-12)


class Lagged(LinearQuadratic):
    """The oracle plant with a filter f of the position and an integral i of the time, which stand between the others.

    df/dt = x − f, di/dt = cos t; observed are f, v, i and sin 3t.
    """

    states = (
        rt.Signal(symbol="f", name="filtered_position", unit="m"),
        *LinearQuadratic.states,
        rt.Signal(symbol="i", name="integral", unit="s"),
    )
    observations = tuple(rt.Signal(symbol="e", name=f"e_{k}", unit="-") for k in range(4))
    controller_states = ("integral", "filtered_position")

    def vector_field(self, t, state, action, exogenous, closure):
        rates = super().vector_field(t, state[..., 1:3], action, exogenous, closure)
        f, x = state[..., 0], state[..., 1]
        return torch.cat([(x - f).unsqueeze(-1), rates, (torch.cos(t) + 0.0 * f).unsqueeze(-1)], -1)

    def observe(self, t, state, exogenous):
        f, _, v, i = state.unbind(-1)
        return torch.stack([f, v, i, torch.sin(3.0 * t) + 0.0 * f], -1)

    def draw_initial_state(self, batch, generator):
        return torch.tensor([[0.0, 1.0, 1.0, 0.0]], dtype=torch.float64).repeat(batch, 1)


GAINS = [[0.4, 0.3, 0.2, 0.5]]


@needs_compiler
def test_filters_clock_and_order_of_the_states(tmp_path):
    """The filter of a straight line is known: f(t+h) = y₁ − r + (f − y₀ + r)e^{−h} with the slope r and h = Δt."""
    assert rt.export_controller(LinearGain(GAINS), tmp_path / "lag.c", Lagged(dt=0.1), name="lag") < CLOSE
    in_c = InC(tmp_path / "lag.c", 1, 2, 2)
    positions = torch.cumsum(torch.randn(50, generator=seeded(), dtype=torch.float64), 0).tolist()
    in_c.start(positions[0], 0.0)
    f, before = 0.0, positions[0]
    for k, x in enumerate(positions):
        t, v = 0.1 * k, 0.1 * x
        if k:
            rate = (x - before) / 0.1
            f = x - rate + (f - before + rate) * math.exp(-0.1)
        before = x
        expected = -(0.4 * f + 0.3 * v + 0.2 * math.sin(t) + 0.5 * math.sin(3.0 * t))
        # One Runge-Kutta step of 0.1 time constants errs by 0.1⁵/120 of what the filter has to go.
        assert in_c.step(x, v)[0] == pytest.approx(expected, abs=2e-6)
    assert in_c.state.steps == 50


@needs_compiler
@pytest.mark.parametrize("kind", rt.shipped_plants().values())
def test_controllers_of_the_plants(kind, tmp_path, monkeypatch):
    monkeypatch.setattr("rt_torchrl.export.c_controller.INTERVALS", 100)
    plant = kind()
    policy = plant.make_policy(seeded())
    assert rt.export_controller(policy, tmp_path / "it.c", plant, name="it") < CLOSE
    InC(tmp_path / "it.c", len(plant.actions), len(plant.controller_states), 9)  # without a warning


# What is no controller is refused; angles go the short way.


class Guessed(Lagged):
    """A plant whose filter depends on the closure."""

    def vector_field(self, t, state, action, exogenous, closure):
        rates = super().vector_field(t, state, action, exogenous, closure)
        return torch.cat([rates[..., :1] + closure(state[..., 1:3])[..., 1:], rates[..., 1:]], -1)


class Summing(LinearQuadratic):
    """A plant with the integral of the force that acts, i."""

    states = (*LinearQuadratic.states, rt.Signal(symbol="i", name="impulse", unit="N s"))
    controller_states = ("impulse",)

    def vector_field(self, t, state, action, exogenous, closure):
        return torch.cat([super().vector_field(t, state[..., :2], action, exogenous, closure), action], -1)

    def observe(self, t, state, exogenous):
        return state[..., 1:]


@pytest.mark.parametrize(
    ("plant", "gains", "states"),
    [
        (Guessed(dt=0.1), GAINS, "integral, filtered_position"),
        (rt.LaggedActuator(Summing(), "force", 0.3), [[0.1, 0.2]], "impulse"),  # of which the lag is not known
    ],
)
def test_what_is_no_controller_is_refused(plant, gains, states, tmp_path):
    with pytest.raises(ValueError, match=rf"its states \({states}\) depend on the closure"):
        rt.export_controller(LinearGain(gains), tmp_path / "it.c", plant)
    assert not list(tmp_path.iterdir())


@needs_compiler
def test_a_wrong_translation_is_not_written(tmp_path, monkeypatch):
    right = CSource.text
    monkeypatch.setattr(CSource, "text", lambda source: right(source).replace("0.25", "0.2500004"))
    with pytest.raises(ValueError, match="the controller it in C differs from the original"):
        rt.export_controller(LinearGain([[0.25, 1.0]]), tmp_path / "it.c", LinearQuadratic(), name="it")
    assert not list(tmp_path.iterdir())


# The twin in C: one interval of every plant against torch and against closed forms.


@needs_compiler
@pytest.mark.parametrize(("name", "kind"), [*((name, "own") for name in rt.shipped_plants()), ("wind_turbine", "mlp")])
def test_twins_of_the_plants(name, kind, tmp_path):
    """A flight in C, whose states are fed back, ends where the plant's own flight ends."""
    plant = rt.shipped_plants()[name]()
    closure = plant.make_closure(seeded()) if kind == "own" else plant.make_neural_closure(seeded(), (16, 16))
    assert rt.export_twin(closure, tmp_path / "twin.c", plant, name="twin") < CLOSE
    state, exogenous = plant.draw_initial_state(1, seeded()), plant.draw_exogenous(1, seeded())[:, :50]
    middle = torch.tensor([[0.5 * (a.low + a.high) for a in plant.actions]], dtype=torch.float64)
    (expected,), *_ = stepped(plant, closure, state, exogenous, lambda *_: middle)
    found, step = c_array(state[0].tolist()), library(tmp_path / "twin.c").twin_step
    for k, z in enumerate(exogenous[0].tolist()):  # the next state is written where the state was read
        step(ctypes.c_double(k * plant.dt), found, c_array(middle[0].tolist()), c_array(z), found)
    assert expected.isfinite().all()
    torch.testing.assert_close(torch.tensor(found, dtype=torch.float64), expected[-1], rtol=CLOSE, atol=CLOSE)
