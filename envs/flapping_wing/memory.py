r"""What a controller of the drone remembers: the stroke plane angle that it applied last, and low-passed positions.

A sensor of the position alone tells the speed by a filter, whose difference from the position is the speed behind it,

.. math:: \dot x_F = \omega_F(x - x_F), \qquad \hat{\dot x} = \omega_F(x - x_F)
"""

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.envs.flapping_wing.measurements import ACTIONS, FILTERED, POSITION_FILTER, STATES
from rt_torchrl.plants.sampling import between, lag

if TYPE_CHECKING:
    from rt_torchrl.envs.flapping_wing.plant import FlappingWing

BODY = len(STATES)
"""Number of states of the body, which stand before those of the controller."""


def filter_rates(state: Float[Tensor, "*batch n_s"], count: int) -> Float[Tensor, "*batch {count}"]:
    """Rates of the last ``count`` states, the low-passed positions [m/s]; these rates are the speeds that they tell."""
    return POSITION_FILTER * (state[..., :count] - state[..., state.shape[-1] - count :])


def latch(
    plant: "FlappingWing", state: Float[Tensor, "*batch n_s"], applied: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch n_s"]:
    """The end state, with the stroke plane angle that was applied, if there is a state for it."""
    angle = applied[..., 1:][..., : plant.remembered]
    return torch.cat([state[..., :BODY], angle, state[..., BODY + plant.remembered :]], -1)


def seen_velocity(plant: "FlappingWing", state: Float[Tensor, "*batch n_s"]) -> Float[Tensor, "*batch 2"]:
    """Speed [m/s] as a controller knows it: by the filters of the position where there are some, or as measured."""
    return filter_rates(state, plant.filtered) if plant.filtered else state[..., 2:BODY]


def completed(
    plant: "FlappingWing",
    measured: dict[str, Float[Tensor, " samples"]],
    exogenous: Float[Tensor, "n n_z"],
    actions: Float[Tensor, "n 2"],
) -> dict[str, Float[Tensor, " samples"]]:
    """What a controller would have remembered along a log, beside what was logged."""
    found = {ACTIONS[1].name: torch.cat([actions[:1, 1], actions[:, 1]])}
    for k, signal in enumerate(FILTERED[: plant.filtered]):
        if STATES[k].name in measured:
            position = measured[STATES[k].name]
            found[signal.name] = lag(position[0], between(position), plant.dt * POSITION_FILTER)
    return found | measured


def started(
    plant: "FlappingWing", measured: Float[Tensor, "*batch n_y"], exogenous: Float[Tensor, "*batch n_z"]
) -> Float[Tensor, "*batch n_c"]:
    """The memory of a controller that is switched on: an upright stroke plane, and settled filters."""
    upright = measured.new_zeros(*measured.shape[:-1], plant.remembered)
    return torch.cat([upright, measured[..., : plant.filtered]], -1)
