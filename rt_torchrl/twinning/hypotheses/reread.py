"""A plant that begins some intervals with what sensors read, while its hidden states go on."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant, Transition
from rt_torchrl.plants.signal import Signal
from rt_torchrl.trajectories.trajectory import Trajectory


class Reread(Extension):
    """A plant whose further inputs hold readings, and whether an interval begins with them.

    Over segments that begin with readings, the states are nearly linear in the weights. The hidden states go on from
    one segment to the next, so that all segments show the weights on which the hidden states depend.

    Args:
        base: the plant.
    """

    def __init__(self, base: Plant):
        super().__init__(base, [])
        self._met, self._read = len(base.inputs), len(base.readings)
        readings = [Signal(symbol=s.symbol, name=f"read_{s.name}", unit=s.unit) for s in base.readings]
        self.inputs = (*base.inputs, *readings, Signal(symbol="r", name="is_read", unit="-"))

    def step(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        command: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Transition:
        """One interval of the plant from the readings, or from its own states."""
        met, read, flag = exogenous.split([self._met, self._read, 1], -1)
        own, hidden = state[..., : self._read], state[..., self._read :]
        known = torch.where(flag + torch.zeros_like(own) > 0.5, read + torch.zeros_like(own), own)
        return self.base.step(t, torch.cat([known, hidden], -1), command, met, closure)


def reread(record: Trajectory, plant: Plant, segment: int) -> Trajectory:
    """A record as a :class:`Reread` plant replays it, with the readings at the start of every segment.

    Args:
        record: the record, as sensors read it.
        plant: the plant; its hidden states are at rest at the start.
        segment: number of control intervals of a segment.
    """
    read = record.states[:-1]
    flag = torch.zeros_like(read[:, :1])
    starts = torch.arange(0, len(read), segment, device=read.device)
    if record.seen is not None:  # from each start on, the next sample that was measured
        measured = record.seen[:-1].nonzero().flatten()
        place = torch.searchsorted(measured, starts)
        starts = measured[place[place < len(measured)]]
    flag[starts] = 1.0
    return at_rest(record, plant)._replace(exogenous=torch.cat([record.exogenous, read, flag], -1))


def at_rest(record: Trajectory, plant: Plant) -> Trajectory:
    """A record with the hidden states of a plant at rest, of which a replay takes those of the start."""
    return record._replace(states=plant.at_rest(record.states))
