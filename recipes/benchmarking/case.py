"""What is computed: a plant with a closure, a policy and the scenario that all contenders share."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from rt_torchrl import Plant, SaturatedMLP, Scenario, shipped_plants

PlantName = Literal["flapping_wing", "wind_turbine", "cryogenic_tank"]
ClosureKind = Literal["law", "mlp"]
PolicyKind = Literal["affine", "mlp"]
STEPS_OF: dict[PlantName, float] = {"cryogenic_tank": 4.32}
"""Control intervals that differ from the plants' own [s]: with 30 s the tank would run empty within 1e5 intervals."""
HIDDEN = (32, 32)
"""Widths of the hidden layers of every perceptron."""


@dataclass(frozen=True)
class Case:
    """A plant with the kinds of its closure and its policy; affine stands for the plant's own policy."""

    plant: PlantName
    closure: ClosureKind = "law"
    policy: PolicyKind = "affine"

    @property
    def name(self) -> str:
        return f"{self.plant}, closure {self.closure}, policy {self.policy}"


@dataclass(frozen=True)
class System:
    """The modules of a case with random weights; those of the closure are fixed, as when a policy is planned."""

    case: Case
    plant: Plant
    closure: nn.Module
    policy: nn.Module

    def weights(self) -> list[Tensor]:
        """The weights that the gradient is taken by, those of the policy."""
        return list(self.policy.parameters())


def system_of(case: Case, seed: int = 0) -> System:
    """The plant of a case with a closure and a policy of random weights."""
    generator = torch.Generator().manual_seed(seed)
    plant = plant_of(case)
    if case.closure == "law":
        closure = plant.make_closure(generator)
    else:
        closure = plant.make_neural_closure(generator, HIDDEN)
        # The last layer is zero at first, so that the layers before would not count.
        last = closure.get_submodule("correction.network")[-1]
        nn.init.normal_(last.weight, 0.0, 0.05, generator=generator)
    if case.policy == "affine":
        policy = plant.make_policy(generator)
    else:
        policy = SaturatedMLP(len(plant.observations), plant.actions, hidden=HIDDEN, generator=generator)
    return System(case, plant, closure.requires_grad_(False), policy)


def plant_of(case: Case, steps: int | None = None) -> Plant:
    """The plant of a case, with episodes of this many control intervals or of its own number."""
    kind, dt = shipped_plants()[case.plant], STEPS_OF.get(case.plant)
    options = {} if dt is None else {"dt": dt}
    return kind(**options) if steps is None else kind(**options, horizon=steps * kind(**options).dt)


def scenario_of(case: Case, steps: int, realisations: int, seed: int = 1) -> Scenario:
    """Initial states and exogenous inputs of episodes of this many control intervals."""
    generator, plant = torch.Generator().manual_seed(seed), plant_of(case, steps)
    return Scenario(plant.draw_initial_state(realisations, generator), plant.draw_exogenous(realisations, generator))
