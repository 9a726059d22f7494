"""A record of what sensors read, which need not be the whole state, and of which samples may be missing."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rt_torchrl.fit.sensors import Sensor, read
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of

DRAWS = 100
"""Number of initial states of a plant whose mean is the guess of a hidden one."""


class SensorRecord(NamedTuple):
    """Readings and actions of a real system over n control intervals.

    Args:
        readings: what the sensors read in the samples t_0 ... t_n; NaN where a sample is missing.
        actions: actions that were applied in the n intervals.
        exogenous: exogenous inputs z, held over the same intervals.
        guess: first guess of the state in t_0.
        start: time t_0 on the plant's clock [s].
        course: guesses of the states in all samples, from which parts of the record begin; None if there are none.
    """

    readings: Float[Tensor, "n+1 n_y"]
    actions: Float[Tensor, "n n_a"]
    exogenous: Float[Tensor, "n n_z"]
    guess: Float[Tensor, " n_s"]
    start: float = 0.0
    course: Float[Tensor, "n+1 n_s"] | None = None

    @property
    def seen(self) -> Bool[Tensor, "samples n_y"]:
        """Whether there is a sample."""
        return ~self.readings.isnan()

    def part(self, first: int, last: int, dt: float, guess: Float[Tensor, " n_s"] | None = None) -> "SensorRecord":
        """The intervals ``first`` to ``last`` − 1 of length ``dt`` [s], with the samples around them.

        Args:
            first, last: numbers of intervals.
            dt: control interval [s].
            guess: first guess of the state there; by default that of the course, or else the record's own.
        """
        held, samples = slice(first, last), slice(first, last + 1)
        course = None if self.course is None else self.course[samples]
        if guess is None:
            guess = self.guess if course is None else course[0]
        return SensorRecord(
            self.readings[samples],
            self.actions[held],
            self.exogenous[held],
            guess,
            self.start + first * dt,
            course=course,
        )


def sensor_record(plant: Plant, sensors: Sequence[Sensor], record: Trajectory) -> SensorRecord:
    """What sensors read along a trajectory; its first state is the guess."""
    return sensor_records(plant, sensors, batch_of([record]))[0]


@torch.no_grad()
def sensor_records(plant: Plant, sensors: Sequence[Sensor], batch: Trajectory) -> list[SensorRecord]:
    """What sensors read along each trajectory of a batch; the first states are the guesses."""
    states, actions, exogenous, start, seen = batch
    first = torch.as_tensor(start, dtype=torch.float64, device=states.device).expand(len(states))
    t = first.unsqueeze(-1) + plant.dt * torch.arange(states.shape[1], dtype=torch.float64, device=states.device)
    readings = read(sensors, plant, t, states, held_to_the_end(exogenous))
    if seen is not None:
        readings = torch.where(seen.unsqueeze(-1), readings, torch.nan)
    each = zip(readings, actions, exogenous, states, first.tolist(), strict=True)
    return [SensorRecord(y, a, z, course[0], start, course=course) for y, a, z, course, start in each]


def segments(record: SensorRecord, length: int, dt: float) -> list[SensorRecord]:
    """A record cut into segments, each with a first state of its own (multiple shooting).

    The sample at a cut belongs to the segment that ends there.

    Args:
        record: the record.
        length: number of control intervals of a segment; the last one takes what is left.
        dt: control interval [s].
    """
    n, parts = len(record.actions), []
    for first in range(0, n, length):
        part = record.part(first, min(first + length, n), dt)
        if first:
            readings = part.readings.clone()
            readings[0] = torch.nan
            part = part._replace(readings=readings)
        parts.append(part)
    return parts


def held_to_the_end(exogenous: Float[Tensor, "*batch n n_z"]) -> Float[Tensor, "*batch samples n_z"]:
    """Inputs of all samples; the last sample, which no interval follows, has those of the last interval."""
    return torch.cat([exogenous, exogenous[..., -1:, :]], -2)


def usual_initial_state(plant: Plant, *, seed: int = 0) -> Float[Tensor, " n_s"]:
    """Mean of the initial states that a plant draws, the guess of a state that no sensor reads."""
    return plant.draw_initial_state(DRAWS, torch.Generator().manual_seed(seed)).mean(0)
