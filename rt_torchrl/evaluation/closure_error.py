"""The error of a closure where the real system has been, because a twin can only learn there."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Trajectory


class Probe(nn.Module):
    """A closure that returns what another closure returns, and keeps the features that it was called with.

    Args:
        closure: closure that gives the coefficients.
    """

    def __init__(self, closure: nn.Module):
        super().__init__()
        self.closure = closure

    def forward(self, features: Tensor) -> Tensor:
        self.features = features
        return self.closure(features)


@torch.no_grad()
def visited_features(plant: Plant, record: Trajectory) -> Float[Tensor, "n *elements n_f"]:
    """The features on which the vector field calls its closure, in every sample of a real episode.

    Args:
        plant: plant with the closure of the real system.
        record: the real episode.
    """
    probe = Probe(plant.closure)
    clock = torch.arange(len(record.actions), dtype=torch.float64, device=record.states.device)
    t = record.start + plant.dt * clock
    plant.vector_field(t, record.states[:-1], record.actions, record.exogenous, probe)
    return probe.features


@torch.no_grad()
def rms_error(
    closure: nn.Module, true: nn.Module, features: Float[Tensor, "*points n_f"]
) -> Float[Tensor, " n_coefficients"]:
    """Root mean square error of every coefficient of a closure over the points."""
    error = closure(features) - true(features)
    return error.flatten(0, -2).square().mean(0).sqrt()
