"""Plants whose identification is known: a line, which is regression, and a room whose wall no sensor reads."""

import math

import numpy as np
import torch
from torch import nn

from rt_torchrl import Plant, PositiveCoefficients, Rollout, Trajectory, sensor_record, sensors_of
from rt_torchrl.plants.signal import Signal, bounds


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


# A heated room whose wall no sensor reads, and records of its air temperature.


class Envelope(PositiveCoefficients):
    """Conductances from the air to the wall and outdoors [W/K], and the wall's heat capacity [MJ/K]."""

    names = {"to_wall": "W/K", "outdoors": "W/K", "capacity": "MJ/K"}
    true_coefficients = (60.0, 90.0, 4.0)

    def forward(self, features):
        return self.coefficients.expand(*features.shape[:-1], 3)


class Room(Plant):
    r"""0.5 MJ/K Ṫ = G_w (T_w − T) + G_o (z − T) + a and C Ṫ_w = G_w (T − T_w)."""

    name = "room"
    states = (
        Signal(symbol="T", name="air", unit="degC"),
        Signal(symbol="T_w", name="wall", unit="degC"),
    )
    actions = (Signal(symbol="a", name="heater", unit="W", low=0.0, high=3000.0),)
    inputs = (Signal(symbol="z", name="outside", unit="degC"),)
    observations = states[:1]

    def __init__(self, dt=300.0, horizon=86400.0):
        super().__init__(dt=dt, horizon=horizon, closure=Envelope.true())

    def vector_field(self, t, state, action, exogenous, closure):
        air, wall = state.unbind(-1)
        to_wall, outdoors, capacity = closure(state).unbind(-1)
        into_wall = to_wall * (air - wall)
        rate = (outdoors * (exogenous[..., 0] - air) - into_wall + action[..., 0]) / 0.5e6
        return torch.stack([rate, into_wall / (1e6 * capacity)], -1)

    discrepancy_scales = (1.0, float("inf"))

    def draw_initial_state(self, batch, generator):
        return 20.0 + 3.0 * torch.randn(batch, 2, generator=generator, dtype=torch.float64)

    observe = running_cost = draw_exogenous = make_closure = None


def room_records(seed=0, noise=0.05, lengths=(200, 120)):
    """Records of the air temperature, with noise and a missing hour, that begin with a wall between 12 and 17 degC."""
    plant, generator = Room(), torch.Generator().manual_seed(seed)
    sensors, records = sensors_of(plant, ["air"]), []
    for n in lengths:
        wall = 12.0 + 5.0 * torch.rand(1, generator=generator, dtype=torch.float64).item()
        on = (torch.rand(n // 20 + 1, generator=generator, dtype=torch.float64) > 0.5).double()
        heater = 3000.0 * on.repeat_interleave(20)[:n].reshape(1, n, 1)
        outside = 5.0 + 4.0 * torch.sin(2.0 * math.pi * torch.arange(n).double() * plant.dt / 86400.0).reshape(1, n, 1)
        with torch.no_grad():
            flown = Rollout(plant, plant.closure)(torch.tensor([[19.0, wall]]).double(), outside, heater)
        record = sensor_record(plant, sensors, flown.each()[0])
        readings = record.readings + noise * torch.randn(n + 1, 1, generator=generator, dtype=torch.float64)
        readings[30:42] = torch.nan
        records.append(record._replace(readings=readings, guess=torch.tensor([readings[0, 0].item(), 20.0]).double()))
    return plant, sensors, records
