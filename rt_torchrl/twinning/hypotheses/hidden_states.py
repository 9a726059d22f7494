"""Hidden states along a record: what no sensor reads, given what the sensors read."""

from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from rt_torchrl.trajectories.engines import Native
from rt_torchrl.trajectories.engines.interval import Drive, Interval
from rt_torchrl.trajectories.rollout import drive_of, require_finite
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin


class ReadInterval(Interval):
    """One control interval that begins with the states that sensors read; the drive's command holds (a, s)."""

    def forward(self, state: Tensor, drive: Drive) -> Tensor:
        """The state at the end of the interval."""
        action, read = drive.command.split((len(self.plant.actions), len(self.plant.readings)), -1)
        known = torch.cat([read, state[..., read.shape[-1] :]], -1)
        return self.plant.step(drive.t, known, action, drive.exogenous, self.closure).state


_intervals: "WeakKeyDictionary[DigitalTwin, ReadInterval]" = WeakKeyDictionary()
"""The interval of each twin. The engine compares what is new to it with all that it knows, which takes milliseconds."""


@torch.no_grad()
def with_hidden_states(twin: DigitalTwin, record: Trajectory) -> Trajectory:
    """The record with the hidden states of a twin's plant, which follow from the readings of every interval.

    The hidden states are at rest at the start. Errors of the twin do not build up in them, because every interval
    begins with what was read.

    Raises:
        DivergenceError: if the hidden states diverge all the same.
    """
    plant, read = twin.plant, record.states
    start = plant.at_rest(read[:1])
    if start.shape[-1] == read.shape[-1]:
        return record
    drive = drive_of(plant, record.exogenous[None], torch.cat([record.actions, read[:-1]], -1)[None])
    interval = _intervals.get(twin)
    if interval is None or interval.plant is not plant or interval.closure is not twin.closure:
        interval = _intervals[twin] = ReadInterval(plant, twin.closure, None)
    ends = Native(compiled=False).end_states(interval, start, drive)[:, 0]
    require_finite(plant, ends.unsqueeze(1), start, [twin.closure])
    states = torch.cat([start, ends])
    return record._replace(states=torch.cat([read, states[:, read.shape[-1] :]], -1))
