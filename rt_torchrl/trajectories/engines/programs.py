"""The programs of intervals: traced when they are first needed, kept as long as a process lives."""

import threading
import warnings
from collections import OrderedDict

import torch
from torch import Tensor, nn

from rt_torchrl.programs.fingerprint import fingerprint
from rt_torchrl.programs.program import UntraceableError
from rt_torchrl.programs.vector_functions import Lanes, lanes_of_this_machine
from rt_torchrl.trajectories.engines.interval import Drive
from rt_torchrl.trajectories.engines.traced_interval import March, Point, Sweep

KEPT = 256
"""Number of kinds of intervals whose programs are kept."""
NUDGE = 1e-3
"""Relative change of the states at which machine code is compared with torch, so that no two of them are equal."""
_kept: "OrderedDict[tuple[object, ...], Programs | UntraceableError]" = OrderedDict()
_lock = threading.RLock()


class Programs:
    """The machine code of one kind of interval.

    Args:
        interval: the map Φ.
        point: a point at which it is traced, and compared with torch.
        lanes: lanes of the processor.
        alive: objects that the fingerprint of the interval knows by their address.
    """

    def __init__(self, interval: nn.Module, point: Point, lanes: Lanes, alive: tuple[object, ...]):
        self.interval, self.point, self.lanes, self._alive = interval, point, lanes, alive
        self._march = March(interval, point, lanes)
        self._sweeps: dict[bool, Sweep] = {}

    @property
    def width(self) -> int:
        """Number of signals of the drive."""
        return self._march.sizes["x"]

    def march(self) -> March:
        """The recurrence."""
        return self._march

    def sweep(self, driven: bool) -> Sweep:
        """The reverse sweep, with or without the gradients by the drive."""
        with _lock:
            if driven not in self._sweeps:
                self._sweeps[driven] = Sweep(self.interval, self.point, self.lanes, driven=driven)
            return self._sweeps[driven]


def programs_of(
    interval: nn.Module, initial_state: Tensor, drive: Drive, *, sweep: bool = False, driven: bool = False
) -> Programs | None:
    """The programs of an interval; None where it is not on the CPU or, with one warning, cannot become a program.

    Args:
        interval: the map Φ.
        initial_state: initial states, near which machine code is compared with torch.
        drive: the drive of the trajectory.
        sweep: whether a gradient is wanted.
        driven: whether the gradient by the drive is wanted.
    """
    if initial_state.device.type != "cpu":
        return None
    with _lock:
        lanes = lanes_of_this_machine()
        digest, alive = fingerprint(interval)
        key = (digest, lanes, initial_state.shape[-1], drive.exogenous.shape[-1], drive.command.shape[-1])
        found = _kept.get(key)
        if not isinstance(found, UntraceableError):
            try:
                found = found or Programs(interval, point_near(initial_state, drive, lanes.number), lanes, alive)
                if sweep:
                    found.sweep(driven)
            except UntraceableError as error:
                found = error
                warnings.warn(f"engine 'parallel' takes the place of 'native': {error}.", stacklevel=2)
            _kept[key] = found
            while len(_kept) > KEPT:
                _kept.popitem(last=False)
        _kept.move_to_end(key)
        return found if isinstance(found, Programs) else None


@torch.no_grad()
def point_near(initial_state: Tensor, drive: Drive, lanes: int) -> Point:
    """States and drive of one interval for every lane, near the initial states and at times over the whole drive."""
    n, batch, lane = len(drive.t), len(initial_state), torch.arange(lanes)
    state = initial_state.detach()[lane % batch]
    state = state + NUDGE * (lane.unsqueeze(-1) / lanes) * (state.abs() + 1e-3 * (state == 0.0))
    at = (lane * n) // lanes
    t = drive.t[at, lane % batch if drive.t.shape[1] > 1 else 0]
    return Point(state, Drive(t, drive.exogenous[at, lane % batch], drive.command[at, lane % batch]))
