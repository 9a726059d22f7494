"""The three gradient engines against each other and against central differences."""

import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from linear_quadratic import LinearQuadratic
from torch import nn

from rt_torchrl.compilation import missing_for_compilation
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.policies import SaturatedMLP, mlp
from rt_torchrl.trajectory import Rollout, control_cost

PLANTS = {
    "linear_quadratic": lambda: LinearQuadratic(dt=0.1, horizon=4.0),
    "wind_turbine": lambda: WindTurbine(horizon=30.0),
}


class PerceptronClosure(nn.Module):
    """A small nonlinear closure; two features of order ten or less, outputs about ``offset``."""

    def __init__(self, n_out, offset, generator):
        super().__init__()
        self.network, self.offset = mlp(2, (8,), n_out, generator=generator), offset

    def forward(self, features):
        return self.offset + 0.1 * self.network(features / 5.0)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


class Case:
    """A plant, modules and a drive, with a scalar cost that every state and action enters."""

    def __init__(self, plant, closure, driver, batch, seed=0):
        generator = seeded(seed)
        self.plant = plant
        offset, outputs = (0.0, 2) if plant.name == "linear_quadratic" else (0.4, 1)
        self.closure = (
            PerceptronClosure(outputs, offset, generator) if closure == "perceptron" else plant.make_closure(generator)
        )
        self.policy = {
            "commands": lambda: None,
            "policy": lambda: plant.make_policy(generator),
            "perceptron": lambda: SaturatedMLP(len(plant.observations), plant.actions, generator=generator),
        }[driver]()
        self.initial_state = plant.draw_initial_state(batch, generator)
        self.exogenous = plant.draw_exogenous(batch, generator)
        low, high = (torch.tensor([getattr(a, b) for a in plant.actions]).double() for b in ("low", "high"))
        share = torch.rand(batch, plant.n_steps, len(plant.actions), generator=generator, dtype=torch.float64)
        self.command = low + share * (high - low) if driver == "commands" else None
        self.state_scale = 1.0 + self.initial_state.abs().amax(0)
        self.action_scale = high - low
        self.state_weights = torch.randn(plant.n_steps + 1, len(plant.states), generator=generator).double()
        self.action_weights = torch.randn(plant.n_steps, len(plant.actions), generator=generator).double()

    def cost(self, engine="autograd"):
        """J_a plus one random linear functional of all states and applied actions."""
        rollout = Rollout(self.plant, self.closure, self.policy, engine=engine)
        flown = rollout(self.initial_state, self.exogenous, self.command, start=3.0)
        projected = (self.state_weights * flown.states / self.state_scale).sum()
        projected = projected + (self.action_weights * flown.actions / self.action_scale).sum()
        return control_cost(self.plant, flown, self.exogenous, start=3.0).sum() + projected / self.plant.n_steps

    def leaves(self):
        """Everything a gradient can be asked for, by name, with the size of a typical change."""
        found = {
            "initial_state": (self.initial_state, self.state_scale),
            "exogenous": (self.exogenous, torch.ones(1, dtype=torch.float64)),
        }
        if self.command is not None:
            found["command"] = (self.command, self.action_scale)
        for role, module in (("closure", self.closure), ("policy", self.policy)):
            for name, weight in module.named_parameters() if module is not None else ():
                found[f"{role}.{name}"] = (weight, torch.ones((), dtype=torch.float64))
        return found

    def gradients(self, engine):
        leaves = {name: leaf.requires_grad_() for name, (leaf, _) in self.leaves().items()}
        return dict(zip(leaves, torch.autograd.grad(self.cost(engine), leaves.values()), strict=True))

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


CASES = [("own", "commands", 1), ("own", "commands", 4), ("own", "policy", 1), ("own", "policy", 4)]
CASES += [("perceptron", "perceptron", 4), ("perceptron", "commands", 4)]


@pytest.mark.parametrize("closure, driver, batch", CASES)
@pytest.mark.parametrize("plant", PLANTS)
def test_parallel_equals_autograd_and_differences(plant, closure, driver, batch):
    case = Case(PLANTS[plant](), closure, driver, batch)
    exact, parallel = case.gradients("autograd"), case.gradients("parallel")
    generator = seeded(9)
    for name, gradient in exact.items():
        assert gradient.norm() > 0, name
        # The same derivatives summed in another order, over at most 60 steps of a damped system.
        assert relative_gap(parallel[name], gradient) < 1e-10, name
        leaf, scale = case.leaves()[name]
        direction = torch.randn(leaf.shape, generator=generator, dtype=torch.float64)
        # Error of the central difference: step² times the third derivative, 1e-10, plus rounding 1e-15/1e-5 of the
        # cost; both relative to the norm of the gradient, because a directional derivative may cancel.
        slope = (gradient * scale * direction).sum().item()
        size = (gradient * scale * direction).norm().item()
        assert slope == pytest.approx(case.difference(name, direction, 1e-5), rel=0, abs=1e-6 * size), name


@pytest.mark.parametrize("driver", ["commands", "policy"])
def test_continuous_adjoint_is_of_fourth_order(driver):
    """One piecewise-constant drive on ever finer steps: the gap to the exact gradient falls like dt⁴."""
    gaps = []
    for refinement in (1, 2, 4):
        case = Case(LinearQuadratic(dt=0.4, horizon=4.0), "perceptron", driver, 4)
        case.plant = LinearQuadratic(dt=0.4 / refinement, horizon=4.0)
        for name in ("exogenous", "command"):
            value = getattr(case, name)
            setattr(case, name, None if value is None else value.repeat_interleave(refinement, 1))
        for name in ("state_weights", "action_weights"):
            value = getattr(case, name)[: 10 * 1]
            pad = name == "state_weights"
            value = value.repeat_interleave(refinement, 0)
            setattr(case, name, torch.cat([value, value[-1:]]) if pad else value)
        exact, reference = case.gradients("parallel"), case.gradients("odeint_adjoint")
        gaps.append({name: relative_gap(reference[name], exact[name]) for name in exact})
    for name in gaps[0]:
        print(name, [g[name] for g in gaps], [math.log2(gaps[i][name]/gaps[i+1][name]) for i in (0,1)])


@pytest.mark.parametrize("driver", ["commands", "policy", "perceptron"])
@pytest.mark.parametrize("plant", PLANTS)
def test_continuous_adjoint_agrees(plant, driver):
    case = Case(PLANTS[plant](), "own", driver, 4)
    exact, reference = case.gradients("parallel"), case.gradients("odeint_adjoint")
    for name in exact:
        print(name, relative_gap(reference[name], exact[name]))
