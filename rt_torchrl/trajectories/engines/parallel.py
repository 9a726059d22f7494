r"""Engine ``parallel``: the exact discrete adjoint, parallel over time.

With one interval as :math:`s_{k+1} = \Phi(s_k, x_k; w)`, the gradient of a cost :math:`J(s_0, \dots, s_n)` is

.. math::
    A_k = \frac{\partial\Phi}{\partial s}(s_k, x_k), \qquad
    \lambda_n = \frac{\partial J}{\partial s_n}, \quad
    \lambda_k = A_k^\top\lambda_{k+1} + \frac{\partial J}{\partial s_k}, \qquad
    \frac{dJ}{dw} = \sum_k \lambda_{k+1}^\top\frac{\partial\Phi}{\partial w}(s_k, x_k).

Only the recurrence of the states and the linear recurrence of λ are sequential. One batched call computes the Jacobians
of all intervals of all trajectories, and another one the sum over k; both are cut into pieces where intervals are many.
Both are backward passes of PyTorch, so that the engine takes whatever the engine ``autograd`` takes.
"""

import shutil
import sysconfig
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rt_torchrl.trajectories.engines.interval import Drive, GradientEngine, march

LIMITS = {
    # One graph per plant, policy and shape; the default of 8 is for loops that recompile by mistake.
    "recompile_limit": 256,
    "accumulated_recompile_limit": 4096,
    # The dt of a second plant would otherwise become a symbol, which a scan cannot capture.
    "specialize_float": True,
}
"""Settings of the tracer."""
PIECE = 2048
"""Greatest number of intervals that are differentiated at once, which bounds the memory."""


class Parallel(GradientEngine):
    """Computes the exact discrete adjoint in parallel over time; the module describes it.

    Args:
        compiled: compile the two recurrences, and the interval that is differentiated.
    """

    def __init__(self, *, compiled: bool = False):
        self.march = compiled_if(compiled, march_by_scan, march)
        self.costates = compiled_if(compiled, costates_by_scan, costates)
        self.intervals = compiled_if(compiled, _all_intervals)

    def end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable."""
        initial_state, drive = prepared(initial_state, drive)
        weights = [w for w in interval.parameters() if w.requires_grad]
        return _DiscreteAdjoint.apply(self, interval, initial_state, *drive, *weights)


class _DiscreteAdjoint(torch.autograd.Function):
    """Maps (s_0, t, z, a, w) to s_1 ... s_n; the engine and the interval are passed along for their maps."""

    @staticmethod
    def forward(
        ctx: Any,
        engine: Parallel,
        interval: nn.Module,
        initial_state: Tensor,
        t: Tensor,
        exogenous: Tensor,
        command: Tensor,
        *weights: Tensor,
    ) -> Tensor:
        ends = engine.march(interval, initial_state, Drive(t, exogenous, command))
        ctx.engine, ctx.interval = engine, interval
        # Saving the weights lets autograd notice when one is changed between forward and backward.
        ctx.save_for_backward(initial_state, t, exogenous, command, ends, *weights)
        return ends

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cost_gradient: Tensor) -> tuple[Tensor | None, ...]:
        initial_state, t, exogenous, command, ends, *weights = ctx.saved_tensors
        starts, drive = torch.cat([initial_state.unsqueeze(0), ends[:-1]]), Drive(t, exogenous, command)
        jacobians = _jacobians(ctx.engine.intervals, ctx.interval, starts, drive)
        sources = marked_dynamic(plain(cost_gradient), 1)
        costates = ctx.engine.costates(marked_dynamic(jacobians[1:], 1), sources)  # λ_1 ... λ_n
        found = _products(ctx.engine.intervals, ctx.interval, starts, drive, weights, costates)
        return None, None, torch.einsum("bji,bj->bi", jacobians[0], costates[0]), *found


def _products(
    function: Callable[[nn.Module, Tensor, Drive], Tensor],
    interval: nn.Module,
    starts: Tensor,
    drive: Drive,
    weights: Sequence[Tensor],
    costates: Tensor,
) -> list[Tensor]:
    """λᵀ∂Φ/∂x for t, z and a of every interval, and its sum over the intervals for every weight.

    The products are computed in pieces, because the tape of an interval holds every unit of a perceptron.
    """
    found = []
    for states, *driven, costate in _pieces(PIECE, starts, drive, costates.flatten(0, 1)):
        driving = [marked_dynamic(plain(x), 0).requires_grad_() for x in driven]
        leaves = *driving, *weights
        with torch.enable_grad():
            end = function(interval, marked_dynamic(plain(states), 0), Drive(*driving))
        found.append(_gradients(end, leaves, costate))
    t, exogenous, command, *of_weights = zip(*found, strict=True)
    # t may be the same for all realisations
    of_drive = [
        torch.cat(parts).unflatten(0, starts.shape[:2]).sum_to_size(x.shape)
        for parts, x in zip((t, exogenous, command), drive, strict=True)
    ]
    return of_drive + [sum(parts, torch.zeros_like(parts[0])) for parts in of_weights]


def _gradients(end: Tensor, leaves: tuple[Tensor, ...], costate: Tensor) -> tuple[Tensor, ...]:
    """λᵀ∂Φ/∂x for each leaf x, zero for those on which an end state does not depend."""
    if not end.requires_grad:
        return tuple(torch.zeros_like(leaf) for leaf in leaves)
    return torch.autograd.grad(end, leaves, costate, allow_unused=True, materialize_grads=True)


def _all_intervals(interval: nn.Module, starts: Tensor, drive: Drive) -> Tensor:
    """Φ at every interval at once."""
    ends: Tensor = interval(starts, drive)
    return ends


def costates(jacobians: Tensor, cost_gradient: Tensor) -> Tensor:
    """The co-states λ_1 ... λ_n from A_1 ... A_{n−1} and ∂J/∂s_1 ... ∂J/∂s_n, by a loop."""
    costate = cost_gradient[-1]
    reversed_costates = [costate]
    for transition, source in zip(jacobians.flip(0), cost_gradient[:-1].flip(0), strict=True):
        costate = torch.einsum("bji,bj->bi", transition, costate) + source
        reversed_costates.append(costate)
    return torch.stack(reversed_costates).flip(0)


def costates_by_scan(jacobians: Tensor, cost_gradient: Tensor) -> Tensor:
    """The co-states of :func:`costates` by one ``scan``, for the compiler."""
    from hoptorch.scan import scan  # here, because it takes seconds to load and only the compiler needs it

    def body(costate: Tensor, x: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        transition, source = x
        costate = ((transition * costate.unsqueeze(-1)).sum(-2) + source).contiguous()
        return costate, costate.clone()

    last = plain(cost_gradient[-1])
    earlier = scan(body, last, (jacobians.flip(0), cost_gradient[:-1].flip(0)))[1]
    return torch.cat([earlier.flip(0), last.unsqueeze(0)])


# All intervals at once


def prepared(initial_state: Tensor, drive: Drive) -> tuple[Tensor, Drive]:
    """State and drive in memory of their own, marked so that one compiled graph serves all batch sizes."""
    copies = Drive(drive.t, plain(drive.exogenous), plain(drive.command))
    for tensor in copies if drive.t.shape[1] > 1 else copies[1:]:
        marked_dynamic(tensor, 1)
    return marked_dynamic(plain(initial_state), 0), copies


def as_one_batch(starts: Tensor, drive: Drive) -> tuple[Tensor, Drive]:
    """The intervals of all realisations as ``n·batch`` rows.

    A function of single intervals does not depend on the trajectories that these belong to. As rows, one graph serves
    every length and every number of realisations, and its loops run over one dimension. With loops over both time and
    realisations, of which t has only the time, the compiler takes a minute for the step of a drone.
    """
    t = drive.t.expand(starts.shape[:2]).flatten()
    return starts.flatten(0, 1), Drive(t, drive.exogenous.flatten(0, 1), drive.command.flatten(0, 1))


def _pieces(size: int, starts: Tensor, drive: Drive, *others: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """States, drive and other rows of the intervals of all realisations, in pieces of at most ``size`` rows."""
    rows, driven = as_one_batch(starts, drive)
    yield from zip(*(x.split(size) for x in (rows, *driven, *others)), strict=True)


def over_all(function: Callable[[Tensor, Drive], Tensor], starts: Tensor, drive: Drive) -> Tensor:
    """``function`` of every interval, ``n batch ...``, in pieces.

    Args:
        function: a function of states and drive of many intervals.
        starts: states at the starts of the intervals.
        drive: times and inputs of the intervals.
    """
    found = [function(states, Drive(*driving)) for states, *driving in _pieces(PIECE, starts, drive)]
    return torch.cat(found).unflatten(0, starts.shape[:2])


def _jacobians(
    function: Callable[[nn.Module, Tensor, Drive], Tensor], interval: nn.Module, starts: Tensor, drive: Drive
) -> Tensor:
    """∂Φ/∂s at every interval, ``n batch n_s n_s``; an interval is computed once for each row of its Jacobian."""
    n_s, found = starts.shape[-1], list[Tensor]()
    basis = torch.eye(n_s, dtype=starts.dtype, device=starts.device)
    for piece in _pieces(max(1, PIECE // n_s), starts, drive):
        state, *driving = (marked_dynamic(x.repeat_interleave(n_s, 0), 0) for x in piece)
        with torch.enable_grad():
            end = function(interval, state.requires_grad_(), Drive(*driving))
        found += _gradients(end, (state,), basis.repeat(len(state) // n_s, 1))
    return torch.cat(found).unflatten(0, (*starts.shape[:2], n_s))


# The recurrence of the states


def march_by_scan(interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
    """The states of :func:`~rt_torchrl.trajectories.engines.interval.march` by one ``scan``, for the compiler."""
    from hoptorch.scan import scan  # here, because it takes seconds to load and only the compiler needs it

    def body(state: Tensor, x: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        # The scan wants a carry that keeps its strides and an output that does not alias it.
        state = interval(state, Drive(*x)).contiguous()
        return state, state.clone()

    return scan(body, plain(initial_state), tuple(drive))[1]


# Compilation by PyTorch, whose compiler takes seconds to load: the functions below import it


def raised_limits() -> AbstractContextManager[None]:
    """A context in which the tracer has the settings that this library compiles under."""
    return torch._dynamo.config.patch(LIMITS)


def compiled_if(
    compiled: bool, function: Callable[..., Any], eager: Callable[..., Any] | None = None
) -> Callable[..., Any]:
    """``torch.compile(function)`` if ``compiled``, otherwise ``eager`` (by default ``function`` itself).

    Raises:
        RuntimeError: if ``compiled`` and this machine has no compiler; the message says what to install.
    """
    if not compiled:
        return function if eager is None else eager
    missing = missing_for_compilation()
    if missing:
        raise RuntimeError(
            f"compiled=True needs {missing}, which this machine lacks. Install it (Debian: apt-get install g++ "
            "python3-dev) or choose compiled=False."
        )
    return _compile(function)


def marked_dynamic(tensor: Tensor, dim: int) -> Tensor:
    """Tell the compiler that a dimension of the tensor changes its size, so that one graph serves all sizes."""
    torch._dynamo.maybe_mark_dynamic(tensor, dim)
    return tensor


def plain(tensor: Tensor) -> Tensor:
    """A copy with the strides of its shape.

    A tensor with a dimension of size one counts as contiguous whatever its stride in that dimension. The compiler
    nevertheless traces again for another stride, and a scan refuses it.
    """
    return tensor.clone(memory_format=torch.contiguous_format)


def missing_for_compilation() -> str | None:
    """The name of what torch.compile lacks on this machine's CPU; None if it lacks nothing."""
    from torch._inductor import config as inductor_config

    candidates = [c for c in inductor_config.cpp.cxx if c] if isinstance(inductor_config.cpp.cxx, tuple) else ["g++"]
    if not any(shutil.which(str(candidate)) for candidate in candidates):
        return "a C++ compiler"
    if not (Path(sysconfig.get_paths()["include"]) / "Python.h").exists():
        return "the headers of Python"
    return None


@cache
def _compile(function: Callable[..., Any]) -> Callable[..., Any]:
    # Cached, so that every user of a function shares its graphs.
    _prepare()
    return torch.compile(function, fullgraph=True, options={"guard_filter_fn": _lasting})


def _lasting(guards: Sequence[Any]) -> list[bool]:
    """Leave out the one guard that fails again and again although nothing has changed.

    TensorDict takes part in every vmap and remembers there which classes are its own. This memory grows as a program
    goes on, and each time the compiler would trace every graph with a vmap in it once more.
    """
    return ["_TENSORCLASS_MEMO" not in guard.name for guard in guards]


@cache
def _prepare() -> None:
    from hoptorch.scan import ensure_scan_backward

    # The scan's backward must have been probed before it is traced.
    ensure_scan_backward("cuda" if torch.cuda.is_available() else "cpu")
    for name, value in LIMITS.items():
        setattr(torch._dynamo.config, name, value)
