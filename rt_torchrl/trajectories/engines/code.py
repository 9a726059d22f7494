"""Machine code of an interval and of its reverse sweep: traced, compared with torch, and kept for its kind."""

import ctypes
import os
import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, cached_property
from itertools import accumulate, chain, islice
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from rt_torchrl.programs.contract import Executed, Holdings, ImpureError, inputs_of, outside_of, require_pure
from rt_torchrl.programs.machine_code import Lanes, ObjectCode, lanes_of_this_machine, march_text, sweep_text
from rt_torchrl.programs.program import UntraceableError
from rt_torchrl.programs.rules import new_tracer
from rt_torchrl.programs.tracer import STRAIGHT, Tracer
from rt_torchrl.trajectories.engines.interval import Drive, costate_products, with_weights

X = (ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)
MARCH = (*X, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)
SWEEP = (*X, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64, *[ctypes.c_void_p] * 4, ctypes.c_int64)
"""Types of the arguments of :func:`march_text` and :func:`sweep_text`."""
AGREEMENT = 1e-8
"""Greatest difference between machine code and torch, relative to the largest value of a signal."""
ROUNDING = 1e-13
"""Greatest difference of gradients by weights, relative to the largest of all gradients: behind a saturated function,
such as 1 − tanh², nothing is left of a gradient but its rounding."""
KEPT = 256
"""Number of kinds of intervals whose machine code is kept."""
ROWS = 8
"""Least number of realisations with which an interval is asked whether it is a function of each alone."""
NUDGE = 1e-3
"""Relative change of the signals of a point, so that no two rows are equal."""


class Inputs:
    """The tensors of an interval that its machine code reads, as long as no others take their places.

    Args:
        interval: the interval.
    """

    def __init__(self, interval: nn.Module):
        self._all = tuple(inputs_of(interval).values())
        self.learned = [w for w in self._all if w.requires_grad]
        self.sizes = [w.numel() for w in self.learned]

    @cached_property
    def _arrays(self) -> list[np.ndarray]:
        """Their numbers in the memory of each."""
        return [w.detach().numpy() for w in self._all]

    def row(self) -> np.ndarray:
        """The present numbers of all of them as one row."""
        return np.concatenate([np.empty(0), *(x.ravel() for x in self._arrays)])

    def split(self, gradients: np.ndarray) -> list[Tensor]:
        """A row of gradients by the learned weights, in their own shapes."""
        parts = (gradients[end - n : end] for n, end in zip(self.sizes, accumulate(self.sizes), strict=True))
        return [torch.from_numpy(part.reshape(w.shape)) for part, w in zip(parts, self.learned, strict=True)]


# Lanes: realisations side by side in the vectors of the processor, and groups of them among threads


class Group(NamedTuple):
    """Realisations ``first`` ... ``last`` − 1 in the lanes of a vector; the last one also fills lanes that are left."""

    first: int
    last: int
    lanes: int

    @property
    def live(self) -> int:
        """Number of lanes with a realisation of their own."""
        return self.last - self.first

    def gather(self, array: np.ndarray) -> np.ndarray:
        """Rows ``n batch signals`` of an array, side by side as ``n signals lanes``."""
        gathered = np.empty((len(array), array.shape[-1], self.lanes))
        gathered[:, :, : self.live] = array[:, self.first : self.last].transpose(0, 2, 1)
        gathered[:, :, self.live :] = gathered[:, :, self.live - 1 : self.live]
        return gathered

    def scatter(self, lanes: np.ndarray, array: np.ndarray) -> None:
        """Put ``n signals lanes`` into the rows of an array ``n batch signals``."""
        array[:, self.first : self.last] = lanes[:, :, : self.live].transpose(0, 2, 1)


def signals_of(drive: Iterable[Tensor]) -> np.ndarray:
    """The address of every signal of tensors ``n batch signals``, and the bytes to the next realisation and row."""
    signals = []
    for x in drive:
        step, lane, signal = x.stride()
        first, lane = x.data_ptr(), lane if x.shape[1] > 1 else 0  # one row for all realisations
        signals += [(first + 8 * signal * j, 8 * lane, 8 * step) for j in range(x.shape[2])]
    return np.array(signals, np.int64).reshape(-1, 3)


def for_each_group(batch: int, lanes: int, work: Callable[[Group], None]) -> None:
    """Do the work of every group, on as many threads as torch may use; whoever is free takes the next group."""
    groups = [Group(first, min(first + lanes, batch), lanes) for first in range(0, batch, lanes)]
    threads = min(torch.get_num_threads(), len(groups))
    for _ in _pool(threads).map(work, groups) if threads > 1 else map(work, groups):
        pass  # which raises what it raised


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="rt_torchrl-native")


if hasattr(os, "register_at_fork"):  # threads do not live on in a forked process
    os.register_at_fork(after_in_child=_pool.cache_clear)


# Points at which an interval is asked


class Point(NamedTuple):
    """States and drive of one interval for a few realisations, at which code is traced and compared."""

    state: Tensor
    drive: Drive

    def in_lanes(self) -> tuple[tuple[np.ndarray, int, int], np.ndarray]:
        """Drive, as machine code takes it, and states ``1 n_s lanes``, one realisation in each lane."""
        lanes, (t, *rest) = Group(0, len(self.state), len(self.state)), self.drive
        signals = signals_of(x.unsqueeze(0) for x in (t.unsqueeze(-1), *rest))
        return (signals, 0, lanes.last - 1), lanes.gather(self.state.unsqueeze(0).numpy())

    def rows(self, chosen: Tensor) -> "Point":
        """Some of the realisations."""
        return Point(self.state[chosen], Drive(*(x[chosen] for x in self.drive)))


@torch.no_grad()
def point_of(initial_state: Tensor, drive: Drive, count: int, sums: int = 0) -> Point:
    """States and drive of one interval for a number of rows, near the initial states and at times over the whole drive.

    Behind the states are the sums of the interval, which begin with zero.
    """
    n, batch, row = len(drive.t), len(initial_state), torch.arange(count, device=initial_state.device)
    at = (row * n) // count
    t = drive.t[at, row % batch if drive.t.shape[1] > 1 else 0]
    driving = (_nudged(x[at, row % batch]) for x in (drive.exogenous, drive.command))
    return Point(_nudged(functional.pad(initial_state.detach()[row % batch], (0, sums))), Drive(t, *driving))


def _nudged(x: Tensor) -> Tensor:
    """Rows of which no two are equal."""
    share = torch.arange(len(x), device=x.device).unsqueeze(-1) / len(x)
    return x + NUDGE * share * (x.abs() + (x == 0.0))


# Machine code of one kind of interval


class IntervalCode:
    """The machine code of one kind of interval: ``march(x, s, w, n)`` and, once it is prepared, the reverse sweep.

    :mod:`rt_torchrl.programs.machine_code` describes both functions.

    Args:
        interval: the map Φ; its attribute ``straight``, if it has one, is that of the :class:`Tracer`.
        point: a point at which it is traced, and compared with torch.
        lanes: lanes of the processor.
        holdings: what the interval holds.

    Raises:
        UntraceableError: if the interval cannot become a program, reads what may change unnoticed, or its program
            differs from torch.
    """

    def __init__(self, interval: nn.Module, point: Point, lanes: Lanes, holdings: Holdings | None = None):
        self.point, self.lanes = point, lanes
        self.sweeps: dict[bool, ObjectCode] = {}
        """The reverse sweeps that have been prepared, without and with the gradients by the drive."""
        self._executed, holdings = Executed(), holdings or Holdings(interval)
        tracer = new_tracer(getattr(interval, "straight", STRAIGHT))
        state, drive, weights = _traced_inputs(tracer, interval, point)
        with torch.no_grad(), tracer.following():
            end = with_weights(interval, weights, state, drive)
        if end.shape != state.shape:
            raise UntraceableError(f"states of shape {tuple(state.shape)} become {tuple(end.shape)} in an interval")
        self.sizes = {"x": sum(x.numel() for x in drive), "s": state.shape[-1]}
        self.march = ObjectCode(march_text(tracer.program, tracer.outputs(end), self.sizes, lanes), "march", MARCH)
        x, start = point.in_lanes()
        states = np.concatenate([start, start])
        self.march(*x, states, Inputs(interval).row(), 1)
        with torch.no_grad(), self._executed.noted():
            exact = interval(*point).numpy()
        self.outside = outside_of(interval, holdings, self._executed)
        """Constants outside of the interval that its code has read."""
        require_equal("the end state", states[1].T, exact, point.state.numpy())

    def prepare_sweep(self, interval: nn.Module, driven: bool, holdings: Holdings | None = None) -> None:
        """Make the reverse sweep of an interval of this kind, unless it is there.

        Args:
            interval: the interval.
            driven: whether the sweep gives the gradients by the drive too.
            holdings: what the interval holds.

        Raises:
            UntraceableError: if it cannot become a program, or the program differs from torch.
        """
        if driven in self.sweeps:
            return
        tracer = new_tracer()
        state, drive, weights = _traced_inputs(tracer, interval, self.point)
        costate = torch.ones_like(state)
        tracer.input(costate, "l")
        learned = [weights[name] for name, w in interval.named_parameters() if w.requires_grad]
        parts = [state], [*drive] if driven else [], learned
        leaves = [leaf.requires_grad_() for part in parts for leaf in part]
        with torch.enable_grad(), tracer.following():
            gradients = costate_products(with_weights(interval, weights, state, drive), leaves, costate)
        values = map(tracer.outputs, gradients)
        outputs = [[*chain.from_iterable(islice(values, len(part)))] for part in parts]
        code = ObjectCode(sweep_text(tracer.program, outputs, self.sizes, self.lanes), "sweep", SWEEP)
        self._compare_sweep(code, interval, driven)
        self.outside = outside_of(interval, holdings or Holdings(interval), self._executed)
        self.sweeps[driven] = code

    def _compare_sweep(self, sweep: ObjectCode, interval: nn.Module, driven: bool) -> None:
        inputs, (x, states) = Inputs(interval), self.point.in_lanes()
        costate = 1.0 + 0.1 * np.arange(states[0].size, dtype=float).reshape(states[0].shape)
        by_state, by_drive = costate.copy(), np.zeros((1, self.sizes["x"], self.lanes.number))
        by_weights = np.zeros((sum(inputs.sizes), self.lanes.number))
        sweep(*x, states, np.zeros_like(states), 0, by_state, inputs.row(), by_drive, by_weights, 1)
        exact = self._expected(interval, inputs, torch.ones(len(self.point.state), dtype=torch.bool), costate)
        rows = exact[0].isfinite().all(-1) & exact[1].isfinite().all(-1)
        if not rows.any():
            raise UntraceableError(
                f"torch has no finite gradient of an interval from the state {self.point.state[0].tolist()}. A "
                "branch of torch.where that is not taken may have none: give it an argument for which it has one, "
                "torch.sqrt(torch.where(x > 0, x, 1)) in the place of torch.sqrt(x)"
            )
        if not rows.all():  # such as where(x > 0, sqrt(x), 0): compared where torch has a gradient
            exact = self._expected(interval, inputs, rows, costate)
        at = rows.numpy()
        computed = [by_state.T[at], by_drive[0].T[at] if driven else exact[1]]
        computed += inputs.split(by_weights[:, at].sum(-1))
        largest = max((x.abs().amax().item() for x in exact if x.numel()), default=0.0)
        names = ["state", "drive", *(name for name, w in interval.named_parameters() if w.requires_grad)]
        for name, part, expected in zip(names, computed, exact, strict=True):
            floor = np.full(expected.shape, ROUNDING / AGREEMENT * largest)
            require_equal(f"the gradient by {name}", np.asarray(part), expected.numpy(), floor)

    def _expected(self, interval: nn.Module, inputs: Inputs, rows: Tensor, costate: np.ndarray) -> list[Tensor]:
        """The gradients by states, drive and weights that torch computes for some realisations."""
        point = self.point.rows(rows)
        leaves = [x.clone().requires_grad_() for x in (point.state, *point.drive)]
        with torch.enable_grad(), self._executed.noted():
            end = interval(leaves[0], Drive(*leaves[1:]))
            costates = torch.from_numpy(costate.T)[rows]
            state, t, *rest = costate_products(end, [*leaves, *inputs.learned], costates)
        return [state, torch.cat([t.unsqueeze(-1), *rest[:2]], -1), *rest[2:]]


def require_equal(what: str, computed: np.ndarray, exact: np.ndarray, scale: np.ndarray) -> None:
    """Refuse machine code that differs from torch.

    Raises:
        UntraceableError: if a number differs by more than :data:`AGREEMENT` of the largest finite number of its column.
    """
    sizes = np.abs(np.where(np.isfinite(exact), exact, 0.0)) + np.abs(np.where(np.isfinite(scale), scale, 0.0))
    equal = np.isclose(computed, exact, rtol=0.0, atol=AGREEMENT * sizes.max(0, initial=0.0) + 1e-300, equal_nan=True)
    if not equal.all():
        raise UntraceableError(
            f"{what} differs from what torch computes, such as {computed[~equal][0]} instead of {exact[~equal][0]}. "
            "A number has left torch where tracing cannot follow it, such as by .numpy(), or torch itself is inexact, "
            "as with integers beyond 2**53"
        )


def _traced_inputs(tracer: Tracer, interval: nn.Module, point: Point) -> tuple[Tensor, Drive, dict[str, Tensor]]:
    """State, drive and parameters as inputs of a program, of the last realisation; buffers are inputs themselves.

    A number that code takes from the first realisation of all then differs from the one that was traced.
    """
    state, drive = point.state[-1:].clone(), Drive(*(x[-1:].clone() for x in point.drive))
    tracer.input(state, "s")
    for x in drive:
        tracer.input(x, "x")
    weights = {}
    for name, w in inputs_of(interval).items():
        if w.dtype != torch.float64:
            raise UntraceableError(f"{name} is in {w.dtype}; trajectories need torch.float64")
        if isinstance(w, nn.Parameter):
            w = weights[name] = w.detach().clone()
        tracer.weight(w)
    return state, drive, weights


# Kinds of intervals

_holdings: "WeakKeyDictionary[nn.Module, tuple[Holdings, Inputs]]" = WeakKeyDictionary()
"""What an interval holds, as long as it holds that."""
_codes: "OrderedDict[tuple[object, ...], tuple[IntervalCode | UntraceableError, tuple[object, ...]]]" = OrderedDict()
"""The machine code of each kind of interval, or why there is none, with the objects that are known by address."""
_modes: "WeakKeyDictionary[nn.Module, tuple[bool, ...]]" = WeakKeyDictionary()
"""The modes, training or evaluation, of the modules of an interval when it was found to be a function."""
_lock = threading.RLock()


def code_of(interval: nn.Module, initial_state: Tensor, drive: Drive) -> tuple[IntervalCode, Inputs] | None:
    """The machine code of an interval with its inputs; None where there is none.

    There is none for an interval that is not on the CPU or, with one warning, cannot become machine code. Where the
    first states or weights are no numbers, there is none for this call. Where a gradient is wanted, the sweep is
    prepared too: later the interval may be another one.

    Raises:
        ImpureError: if the interval is no function, or mixes realisations.
    """
    if initial_state.device.type != "cpu":
        return None
    with _lock:
        entry = _holdings.get(interval)
        if entry is None or not entry[0].unchanged(interval):
            entry = _holdings[interval] = Holdings(interval), Inputs(interval)
        (holdings, inputs), sums = entry, getattr(interval, "sums", 0)
        widths = initial_state.shape[-1] + sums, drive.exogenous.shape[-1], drive.command.shape[-1]
        key = (holdings.digest, lanes_of_this_machine(), *widths)
        code, alive = _codes.get(key, (None, tuple(holdings.alive)))
        if isinstance(code, IntervalCode) and not code.outside.same():
            code, alive = None, tuple(holdings.alive)
        driven = any(x.requires_grad for x in drive)
        differentiated = torch.is_grad_enabled() and bool(driven or initial_state.requires_grad or inputs.learned)
        if code is None or (isinstance(code, IntervalCode) and differentiated and driven not in code.sweeps):
            if not all(bool(x.isfinite().all()) for x in (initial_state, *interval.parameters())):
                return None  # nothing to compare with; the next call may have numbers
            point = point_of(initial_state, drive, max(ROWS, lanes_of_this_machine().number), sums)
            code = _compiled(code, interval, point, holdings, driven if differentiated else None)
            _codes[key] = code, alive
            while len(_codes) > KEPT:
                _codes.popitem(last=False)
        _codes.move_to_end(key)
        return None if isinstance(code, UntraceableError) else (code, inputs)


def _compiled(
    code: IntervalCode | None, interval: nn.Module, point: Point, holdings: Holdings, driven: bool | None
) -> IntervalCode | UntraceableError:
    """The machine code with a sweep (None for none), or why there is none."""
    try:
        if code is None:
            require_pure(interval, *point)
            lanes = lanes_of_this_machine()
            one_each = torch.arange(0, len(point.state), len(point.state) // lanes.number)
            code = IntervalCode(interval, point.rows(one_each), lanes, holdings)
        if driven is not None:
            code.prepare_sweep(interval, driven, holdings)
    except ImpureError:
        raise
    except Exception as error:  # code that is traced may raise anything, such as for one realisation alone
        kind = "" if isinstance(error, UntraceableError) else f"{type(error).__name__}: "
        text = kind + str(error).rstrip(".")
        warnings.warn(f"engine 'autograd' takes the place of 'native': {text}.", stacklevel=2)
        return UntraceableError(text)  # without the traceback, which would keep the traced tensors
    return code


def require_pure_once(interval: nn.Module, initial_state: Tensor, drive: Drive) -> None:
    """Refuse what is no function, for an engine that does not trace: when it is new or a module changed its mode.

    Raises:
        ImpureError: as :func:`require_pure`.
    """
    _require_once(interval, interval, lambda: point_of(initial_state, drive, ROWS))


def require_pure_policy(policy: nn.Module, observation: Tensor) -> None:
    """The same of a policy alone, that steps a system.

    Args:
        policy: the policy.
        observation: observations like those that it meets, ``batch n_o``.

    Raises:
        ImpureError: as :func:`require_pure`.
    """
    rows = torch.arange(ROWS, device=observation.device) % len(observation)
    named = nn.Sequential(OrderedDict(policy=policy))  # messages name it by its place
    _require_once(policy, named, lambda: (_nudged(observation.detach()[rows]),))


def _require_once(key: nn.Module, module: nn.Module, question: Callable[[], Sequence[Any]]) -> None:
    modes = tuple(submodule.training for submodule in key.modules())
    if _modes.get(key) != modes:
        require_pure(module, *question())
        _modes[key] = modes
