"""The gradient engines against each other and against central differences."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import seeded
from torch import nn

from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank, PressureCost
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.disturbances import KaimalWind
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.plants.policies import SaturatedMLP, mlp
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.engines import parallel
from rt_torchrl.trajectories.rollout import Rollout

PLANTS = {
    "linear_quadratic": lambda: LinearQuadratic(dt=0.1, horizon=4.0),
    # Below rated wind, between the limits of the reference speed: the field has no kink on the way.
    "wind_turbine": lambda: WindTurbine(horizon=10.0, wind=KaimalWind(mean=8.0, intensity=0.1)),
    # A fifth of a beat, 20 steps.
    "flapping_wing": lambda: FlappingWing(horizon=0.01),
    # Its terminal cost enters by the first state and the last.
    "cryogenic_tank": lambda: CryogenicTank(horizon=300.0, cost=PressureCost(end=43_200.0)),
    "pendulum": lambda: Pendulum(horizon=1.0),
}
# Number of outputs of a perceptron that stands in for a plant's closure, and their offset. The tank's coefficients, of
# sizes 50 to 5e11, are beyond one.
OUTPUTS = {"linear_quadratic": (2, 0.0), "wind_turbine": (1, 0.4), "flapping_wing": (2, 1.0)}


class PerceptronClosure(nn.Module):
    """A small nonlinear closure; two features of order ten or less, outputs about ``offset``."""

    def __init__(self, n_out, offset, generator):
        super().__init__()
        self.network, self.offset = mlp(2, (8,), n_out, generator=generator), offset

    def forward(self, features):
        return self.offset + 0.1 * self.network(features / 5.0)


class Case:
    """A plant, modules and a drive, with a scalar cost that every state and action enters."""

    def __init__(self, plant, closure, driver, batch, seed=0):
        generator = seeded(seed)
        self.plant = plant
        self.closure = {
            "own": lambda: plant.make_closure(generator),
            "true": lambda: plant.closure,
            "perceptron": lambda: PerceptronClosure(*OUTPUTS[plant.name], generator),
        }[closure]()
        self.policy = {
            "commands": lambda: None,
            "policy": lambda: plant.make_policy(generator),
            "perceptron": lambda: SaturatedMLP(len(plant.observations), plant.actions, generator=generator),
        }[driver]()
        self.initial_state = plant.draw_initial_state(batch, generator)
        self.exogenous = plant.draw_exogenous(batch, generator)
        low, high = bounds(plant.actions)
        # Off the ends of the ranges: the tank's valve is laminar within 100 Pa of shut, which the step of a central
        # difference does not resolve.
        share = 0.1 + 0.8 * torch.rand(batch, plant.n_steps, len(plant.actions), generator=generator).double()
        self.command = low + share * (high - low) if driver == "commands" else None
        self.state_scale = 1.0 + self.initial_state.abs().amax(0)
        self.action_scale = high - low
        self.state_weights = torch.randn(plant.n_steps + 1, len(plant.states), generator=generator).double()
        self.action_weights = torch.randn(plant.n_steps, len(plant.actions), generator=generator).double()
        self.rollouts = {}

    def rollout(self, engine):
        """The rollout by an engine, which lasts."""
        if engine not in self.rollouts:
            self.rollouts[engine] = Rollout(self.plant, self.closure, self.policy, engine=engine)
        return self.rollouts[engine]

    def cost(self, engine="autograd"):
        """J_a of each realisation, weighed by its number, and a random linear functional of all states and actions."""
        rollout, given = self.rollout(engine), (self.initial_state, self.exogenous, self.command)
        flown, costs = rollout(*given, start=3.0), rollout.costs(*given, start=3.0)
        projected = (self.state_weights * flown.states / self.state_scale).sum()
        projected = projected + (self.action_weights * flown.actions / self.action_scale).sum()
        return (torch.arange(1.0, 1 + len(costs)).double() * costs).sum() + projected / self.plant.n_steps

    def leaves(self):
        """Tensors that a gradient can be taken by, by name, with the size of a typical change."""
        found = {
            "initial_state": (self.initial_state, self.state_scale),
            "exogenous": (self.exogenous, 1.0 + self.exogenous.abs().mean((0, 1))),
        }
        if self.command is not None:
            found["command"] = (self.command, self.action_scale)
        for role, module in (("closure", self.closure), ("policy", self.policy)):
            weights = [] if module is None else [pair for pair in module.named_parameters() if pair[1].requires_grad]
            for name, weight in weights:
                found[f"{role}.{name}"] = (weight, torch.ones((), dtype=torch.float64))
        return found

    def gradients(self, engine):
        """The cost and its gradients, by name; zero by a weight that is not used."""
        leaves = {name: leaf.requires_grad_() for name, (leaf, _) in self.leaves().items()}
        cost = self.cost(engine)
        found = torch.autograd.grad(cost, leaves.values(), allow_unused=True, materialize_grads=True)
        return {"cost": cost.detach(), **dict(zip(leaves, found, strict=True))}

    @torch.no_grad()
    def difference(self, name, direction, step):
        """Central difference of the cost along a direction of one leaf."""
        leaf, scale = self.leaves()[name]
        costs = []
        for sign in (1.0, -1.0):
            leaf += sign * step * scale * direction
            costs.append(self.cost().item())
            leaf -= sign * step * scale * direction
        return (costs[0] - costs[1]) / (2.0 * step)


def relative_gap(found, reference):
    return ((found - reference).norm() / reference.norm()).item()


def assert_equal(found, exact, bound=1e-10):
    """Equal but for the order of sums over at most some hundred steps of a damped system."""
    for name, gradient in exact.items():
        assert torch.equal(found[name], gradient) or relative_gap(found[name], gradient) < bound, name


CASES = [("own", "commands", 4), ("own", "policy", 4), ("perceptron", "perceptron", 4), ("perceptron", "commands", 4)]
LONE = [("own", "commands", 1), ("own", "policy", 1)]
"""One realisation, which engines may not treat as a batch."""


@pytest.mark.parametrize(
    "plant, closure, driver, batch",
    [(plant, *case) for plant in PLANTS for case in CASES[:2]]
    + [(plant, *case) for plant in ("linear_quadratic", "wind_turbine") for case in CASES[2:]]
    + [pytest.param("flapping_wing", *case, marks=pytest.mark.slow) for case in CASES[2:]]
    + [("linear_quadratic", *case) for case in LONE]
    + [pytest.param(plant, *case, marks=pytest.mark.slow) for plant in OUTPUTS for case in LONE],
)
def test_exact_engines_equal_autograd_and_differences(plant, closure, driver, batch):
    case = Case(PLANTS[plant](), closure, driver, batch)
    exact = case.gradients("autograd")
    for engine in ("parallel", "native"):
        assert_equal(case.gradients(engine), exact)
    generator, value = seeded(9), exact.pop("cost").item()
    walk = case.plant.n_steps**0.5 * (exact["initial_state"] * case.initial_state).abs().sum().item()
    for name, gradient in exact.items():
        assert gradient.any() or not gradient.numel(), name
        leaf, scale = case.leaves()[name]
        direction = torch.randn(leaf.shape, generator=generator, dtype=torch.float64)
        # Error of the central difference: step² times the third derivative, 1e-10 of the norm of the gradient (not of
        # the directional derivative, which may cancel), and rounding over the step: some of the cost, and one of the
        # state in every interval, a random walk (the tank's pressure is 5e5 Pa and moves by 10 Pa an interval).
        slope = (gradient * scale * direction).sum().item()
        size = (gradient * scale * direction).norm().item()
        rounding = torch.finfo(torch.float64).eps * (4.0 * abs(value) + walk) / 1e-5
        tolerance = 1e-6 * size + rounding
        assert slope == pytest.approx(case.difference(name, direction, 1e-5), rel=0, abs=tolerance), name


@pytest.mark.parametrize("driver", ["commands", "policy", "perceptron"])
@pytest.mark.parametrize("plant", sorted(PLANTS.keys() - {"pendulum"}))
def test_continuous_adjoint_agrees(plant, driver):
    case = Case(PLANTS[plant](), "own", driver, 4)
    exact, reference = case.gradients("parallel"), case.gradients("odeint_adjoint")
    # Forwards it flies as the others.
    assert_equal({"cost": reference["cost"]}, {"cost": exact["cost"]}, 1e-12)
    # dt⁴ with a time scale of 1 s: 1e-4 for dt = 0.1 s times the 1/120 of the local error; the turbine's 0.5 s
    # stand against scales of 4 s (filters) and 16 s (rotor). Measured: 4e-6 and below.
    assert_equal(reference, exact, 2e-5)


def test_products_are_made_in_pieces(monkeypatch):
    """Of 160 intervals at most 50 at a time."""
    monkeypatch.setattr(parallel, "PIECE", 50)
    case = Case(PLANTS["linear_quadratic"](), "perceptron", "commands", 4)
    assert_equal(case.gradients("parallel"), case.gradients("autograd"))


class Following(LinearQuadratic):
    """Its state is what was commanded, and not what it was before."""

    def advance(self, t, state, action, exogenous, closure):
        return torch.cat([action, 2.0 * action], -1)


class Free(LinearQuadratic):
    """It moves by itself: nothing that acts on it, and no weight, enters its step."""

    def advance(self, t, state, action, exogenous, closure):
        return state * torch.tensor([0.9, 0.8], dtype=torch.float64)


@pytest.mark.parametrize("plant", [Following, Free])
@pytest.mark.parametrize("engine", ["native", "parallel"])
def test_what_an_interval_does_not_depend_on_has_a_gradient_of_zero(plant, engine):
    """The cost of both plants also depends on the action itself."""
    system = plant(horizon=1.0)
    closure = system.closure.requires_grad_(False)
    gradients = []
    for chosen in (engine, "autograd"):
        start = system.draw_initial_state(2, seeded(1)).requires_grad_()
        command = torch.rand(2, system.n_steps, 1, generator=seeded(2)).double().requires_grad_()
        states = Rollout(system, closure, engine=chosen)(start, system.draw_exogenous(2, seeded(3)), command).states
        cost = states.square().sum()
        gradients.append(torch.autograd.grad(cost, (start, command), materialize_grads=True, allow_unused=True))
    for found, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-13)
    assert gradients[0][0].abs().sum() > 0.0
