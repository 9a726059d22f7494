"""Where a closure was asked: a twin can only know what the real system has visited."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Trajectory


class Probe(nn.Module):
    """A closure that answers as another one and keeps what it was asked for.

    Args:
        closure: gives the coefficients.
    """

    def __init__(self, closure: nn.Module):
        super().__init__()
        self.closure = closure

    def forward(self, features: Tensor) -> Tensor:
        self.features = features
        return self.closure(features)


@torch.no_grad()
def visited_features(plant: Plant, record: Trajectory) -> Float[Tensor, "n *elements n_f"]:
    """What the vector field asks its closure in every sample of a real episode.

    Args:
        plant: with the closure of the real system.
        record: the episode.
    """
    probe = Probe(plant.closure)
    t = plant.dt * torch.arange(len(record.actions), dtype=torch.float64, device=record.states.device)
    plant.vector_field(t, record.states[:-1], record.actions, record.exogenous, probe)
    return probe.features


@torch.no_grad()
def rms_error(
    closure: nn.Module, true: nn.Module, features: Float[Tensor, "*points n_f"]
) -> Float[Tensor, " n_coefficients"]:
    """Root of the mean squared error of every coefficient over the points."""
    error = closure(features) - true(features)
    return error.flatten(0, -2).square().mean(0).sqrt()
