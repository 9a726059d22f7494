"""What an estimation begins with: noise levels, sizes of the states, and first weights that are moved at random."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.fit.sensor_record import SensorRecord
from rt_torchrl.fit.sensors import Sensor
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import differences, state_read

FIRST_NOISE = 0.1
"""First guess of an unknown noise level, as a share of the scatter of the readings."""


def first_noise(sensors: Sequence[Sensor], records: Sequence[SensorRecord]) -> Float[Tensor, " n_y"]:
    """Noise levels that are given; for others a share of the scatter of the readings.

    Raises:
        ValueError: if there is no record, or a sensor has no sample.
    """
    if not records:
        raise ValueError("records=[] of the estimation must hold at least one record.")
    readings = torch.cat([record.readings for record in records])
    levels = []
    for sensor, values in zip(sensors, readings.T, strict=True):
        seen = values[~values.isnan()]
        if not len(seen):
            raise ValueError(f"sensor {sensor.name!r} has no sample in any record; leave it out.")
        origin = seen[:1].expand_as(seen)
        scatter = differences([sensor.measurement], (seen - 0.0)[:, None], origin[:, None]).square().mean().sqrt()
        guess = FIRST_NOISE * scatter.item() or 1e-6 * max(abs(origin[0].item()), 1.0)
        levels.append(guess if sensor.noise is None else sensor.noise)
    return readings.new_tensor(levels)


def state_sizes(
    plant: Plant, first: Float[Tensor, "records n_s"], sensors: Sequence[Sensor], records: Sequence[SensorRecord]
) -> Float[Tensor, " n_s"]:
    """Usual size of each state, in which changes of initial states are measured; 1 where nothing tells it.

    It is the greatest of the scatter of the states that the plant draws, that of what a sensor reads of it, and a tenth
    of the guess.
    """
    drawn = plant.draw_initial_state(100, torch.Generator(device=first.device).manual_seed(0))
    sizes = torch.maximum(drawn.std(0), 0.1 * first.abs().amax(0))
    for column, sensor in enumerate(sensors):
        place = state_read(sensor.measurement.read, plant.states)
        if place is not None:
            values = torch.cat([record.readings[:, column] for record in records])
            values = values[~values.isnan()]
            scatter = (values - values.mean()).square().mean().sqrt()
            sizes[place] = torch.maximum(sizes[place], scatter)
    return torch.where(sizes > 0.0, sizes, 1.0)


@torch.no_grad()
def move(closure: nn.Module, generator: torch.Generator) -> None:
    """Move the weights at random, each by a normal number of some units; a unit is a factor of e for a logarithm."""
    far = 3.0 * torch.rand(1, generator=generator, dtype=torch.float64).item()
    for w in closure.parameters():
        if w.requires_grad:
            w.add_(far * torch.randn(w.shape, generator=generator, dtype=torch.float64).to(w.device))
