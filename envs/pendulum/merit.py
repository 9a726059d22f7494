"""The quantities by which the pendulum's episodes are judged, beside their mean cost."""

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.plants.plant import Plant

UPRIGHT = 0.25
"""Angle within which the rod counts as upright [rad]."""


def merit(
    plant: Plant,
    states: Float[Tensor, "batch samples 2"],
    applied: Float[Tensor, "batch n 1"],
    exogenous: Float[Tensor, "batch n 0"],
) -> dict[str, Float[Tensor, " batch"]]:
    """Gymnasium's return, and the share of the episode's last quarter in which the rod is upright."""
    t = plant.dt * torch.arange(applied.shape[1], dtype=states.dtype, device=states.device)
    cost = plant.running_cost(t, states[:, :-1], applied, exogenous)
    last = states[:, -(applied.shape[1] // 4) :, 0]
    upright = (torch.atan2(last.sin(), last.cos()).abs() < UPRIGHT).to(states.dtype)
    return {"return [-]": -cost.sum(-1), "upright in the last quarter [%]": 100.0 * upright.mean(-1)}
