"""A plant whose identification is linear regression, and segments of records without a file."""

import numpy as np
import torch
from torch import nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal, bounds
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.trajectory import Trajectory


class Slope(nn.Module):
    """ẋ = w_0 + w_1 z; the second weight shows only where there is an input."""

    def __init__(self):
        super().__init__()
        self.w = nn.Parameter(torch.tensor([0.5, 0.3], dtype=torch.float64))

    def forward(self, features):
        return self.w[:1] + self.w[1:] * features


class Line(Plant):
    """x = x_0 + (w_0 + w_1 z) t: identification is linear regression."""

    name = "line"
    states = (Signal(symbol="x", name="position", unit="m"),)
    actions = (Signal(symbol="a", name="nothing", unit="-", low=-1.0, high=1.0),)
    inputs = (Signal(symbol="z", name="wind", unit="-"),)
    observations = states

    def __init__(self, dt=0.1, horizon=10.0):
        super().__init__(dt=dt, horizon=horizon, closure=Slope())

    def vector_field(self, t, state, action, exogenous, closure):
        return closure(exogenous).expand_as(state)

    def draw_initial_state(self, batch, generator):
        return torch.zeros(batch, 1, dtype=torch.float64)

    observe = running_cost = draw_exogenous = make_closure = None


def line_segment(values, wind=0.0, start=0.0):
    n = len(values) - 1
    exogenous = torch.full((n, 1), wind, dtype=torch.float64)
    states = torch.as_tensor(values).reshape(-1, 1).double()
    return Trajectory(states, torch.zeros(n, 1).double(), exogenous, start)


def noise_of(n, seed, *, smooth=False):
    """White noise of unit deviation, or means of neighbouring samples of it."""
    values = np.random.default_rng(seed).normal(size=n + 1)
    return 0.5 * (values[1:] + values[:-1]) if smooth else values[1:]


def flown(plant, generator, lengths):
    """Segments of one true episode, cut at these steps, with their starts on its clock."""
    start, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    low, high = bounds(plant.actions)
    share = 0.3 + 0.4 * torch.rand(1, plant.n_steps, len(plant.actions), generator=generator, dtype=torch.float64)
    with torch.no_grad():
        found = Rollout(plant, plant.closure)(start, exogenous, low + share * (high - low))
    segments, k = [], 0
    for n in lengths:
        segments.append(found.each()[0].part(k, k + n, plant.dt))
        k += n
    return segments
