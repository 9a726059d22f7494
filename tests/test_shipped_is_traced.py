"""Every plant, policy, closure and extension that is shipped becomes machine code: nothing in it is refused."""

import importlib
import warnings

import pytest
import torch

from rt_torchrl.envs.unknown_systems import SYSTEMS
from rt_torchrl.runs.command_line import from_command_line
from rt_torchrl.trajectories.rollout import Rollout

RECIPES = {
    "wind_turbine": (("mlp", "paper", "bias", "scheduled"), ("--task engineering", "--observe preview")),
    "flapping_wing": (("mlp", "paper"), ("--task hop", "--energy 0.1 --tilt 0.1", "--observe phase")),
    "cryogenic_tank": (
        ("mlp", "paper"),
        ("--command drop --end-weight 0", "--observe phase", "--wall exponential"),
    ),
}
"""Policies of each plant, and options that change what it computes."""
POLICIES = [(recipe, policy) for recipe, (policies, _) in RECIPES.items() for policy in policies]
SETS = [(recipe, options) for recipe, (_, sets) in RECIPES.items() for options in sets]


def configured(recipe, options):
    return from_command_line(importlib.import_module(recipe).Config, options.split())


def require_traced(plant, closure, policy):
    """Fly four intervals by machine code; a warning says that another engine takes its place."""
    generator = torch.Generator().manual_seed(0)
    read = plant.draw_initial_state(2, generator)[..., : len(plant.readings)]
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="engine .* takes the place")
        Rollout(plant, closure, policy)(plant.at_rest(read), plant.draw_exogenous(2, generator)[:, :4])


@pytest.mark.parametrize(("recipe", "policy"), POLICIES)
def test_policies_and_closures(recipe, policy):
    config, generator = configured(recipe, f"--policy {policy}"), torch.Generator().manual_seed(0)
    plant = config.plant()
    for closure in (plant.closure, plant.make_closure(generator), plant.make_neural_closure(generator, (4,))):
        require_traced(plant, closure, config.make_policy(plant, generator))


@pytest.mark.parametrize(("recipe", "options"), SETS)
def test_costs_and_observations(recipe, options):
    config = configured(recipe, f"--policy mlp {options}")
    plant = config.plant()
    require_traced(plant, plant.closure, config.make_policy(plant, torch.Generator().manual_seed(0)))


@pytest.mark.parametrize("recipe", RECIPES)
def test_hypotheses(recipe):
    config, generator = configured(recipe, ""), torch.Generator().manual_seed(0)
    plant = config.plant()
    policy = config.make_policy(plant, generator)
    for extended in (dict(plant.suspects()) | dict(plant.further_suspects())).values():
        require_traced(extended, extended.make_closure(generator), policy)


@pytest.mark.parametrize(("recipe", "name"), [(recipe, name) for recipe, names in SYSTEMS.items() for name in names])
def test_systems_that_twins_do_not_know(recipe, name):
    config = configured(recipe, f"--unknown {name} --policy {'scheduled' if recipe == 'wind_turbine' else 'paper'}")
    plant = config.plant()
    require_traced(plant, plant.closure, config.make_policy(config.believed(), torch.Generator().manual_seed(0)))
