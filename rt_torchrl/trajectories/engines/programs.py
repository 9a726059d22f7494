"""The programs of intervals: traced when they are first needed, kept as long as a process lives."""

import threading
import warnings
from collections import OrderedDict
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from rt_torchrl.programs.fingerprint import Fingerprint, fingerprint
from rt_torchrl.programs.program import UntraceableError
from rt_torchrl.programs.vector_functions import Lanes, lanes_of_this_machine
from rt_torchrl.trajectories.engines.interval import Drive
from rt_torchrl.trajectories.engines.purity import ImpureError, require_pure, rows_of
from rt_torchrl.trajectories.engines.traced_interval import Point, Programs, UncomparedError
from rt_torchrl.trajectories.engines.weights import Weights

KEPT = 256
"""Number of kinds of intervals whose programs are kept."""

_known: "WeakKeyDictionary[nn.Module, tuple[Fingerprint, Weights]]" = WeakKeyDictionary()
"""The fingerprint of an interval with its weights, as long as its fingerprint holds."""
_kept: "OrderedDict[tuple[object, ...], tuple[Programs | UntraceableError, tuple[object, ...]]]" = OrderedDict()
"""The programs of each kind of interval, or why there are none for one of its sweeps, with the objects that its
fingerprint knows by their address."""
_lock = threading.RLock()


def programs_of(interval: nn.Module, initial_state: Tensor, drive: Drive) -> tuple[Programs, Weights] | None:
    """The programs of an interval with its weights; None where there are none.

    There are none for an interval that is not on the CPU or, with one warning, cannot become a program. Where the
    first states or weights are no numbers, there are none for this call. Where a gradient is wanted, the sweep is
    prepared too: later the interval may be another one.

    Raises:
        ImpureError: if the interval is no function, or mixes realisations.
    """
    if initial_state.device.type != "cpu":
        return None
    with _lock:
        (held, weights), lanes, sums = _known_as(interval), lanes_of_this_machine(), getattr(interval, "sums", 0)
        widths = initial_state.shape[-1] + sums, drive.exogenous.shape[-1], drive.command.shape[-1]
        key = (held.digest, lanes, *widths)
        found, alive = _kept.get(key, (None, held.alive))
        if isinstance(found, Programs) and not _as_noted(found, held):
            found, alive = None, held.alive
        if not isinstance(found, UntraceableError):
            try:
                found = found or _traced(interval, point_of(initial_state, drive, lanes.number, sums), lanes)
                driven = any(x.requires_grad for x in drive)
                if torch.is_grad_enabled() and (driven or initial_state.requires_grad or weights.learned):
                    found.prepare_sweep(interval, driven)
            except UncomparedError:
                return None  # the next call may have numbers
            except ImpureError:
                raise
            except Exception as error:  # code that is traced may raise anything, such as for one realisation alone
                found = _reason(error)
                warnings.warn(f"engine 'autograd' takes the place of 'native': {found}.", stacklevel=2)
            _kept[key] = found, alive
            while len(_kept) > KEPT:
                _kept.popitem(last=False)
        _kept.move_to_end(key)
        if isinstance(found, Programs) and not held.watch.guarded(found.guards):
            held.watch.guard(found.guards)
        return (found, weights) if isinstance(found, Programs) else None


def _as_noted(programs: Programs, held: Fingerprint) -> bool:
    """Whether constants outside of the interval are what they were; those that are watched are."""
    return held.watch.guarded(programs.guards) or all(guard.holds() for guard in programs.guards)


def _traced(interval: nn.Module, point: Point, lanes: Lanes) -> Programs:
    require_pure(interval, *point)
    return Programs(interval, point, lanes)


def _known_as(interval: nn.Module) -> tuple[Fingerprint, Weights]:
    found = _known.get(interval)
    if found is None or not found[0].watch.holds(interval):
        found = _known[interval] = fingerprint(interval), Weights(interval)
    return found


def _reason(error: Exception) -> UntraceableError:
    """Why there is no program, without the traceback, which would keep the traced tensors."""
    if isinstance(error, UntraceableError):
        return error.with_traceback(None)
    return UntraceableError(f"an interval of one realisation raises {type(error).__name__}: {str(error).rstrip('.')}")


def point_of(initial_state: Tensor, drive: Drive, lanes: int, sums: int = 0) -> Point:
    """States and drive of one interval for every lane; see :func:`rows_of`."""
    return Point(*rows_of(initial_state, drive, lanes, sums))
