r"""The recurrence :math:`s_{k+1} = \Phi(s_k, x_k)` for all k at once, by Newton's method on whole trajectories.

The unknowns are the states :math:`s_1 \dots s_n`, the equations :math:`r_k = \Phi(s_k, x_k) - s_{k+1} = 0`. A step of
Newton's method is a linear recurrence, which :func:`linear_recurrence` solves in parallel,

.. math:: \delta_0 = 0, \qquad \delta_{k+1} = A_k\delta_k + r_k, \qquad A_k = \frac{\partial\Phi}{\partial s}(s_k, x_k).

Near the trajectory the error is squared by every step. Far from it a step may lead away: where the guess saturates a
rate limiter, the linear model drifts without end. Two things keep the guess near.

- Sweeps :math:`s_{k+1} \leftarrow \Phi(s_k, x_k)`, for all k at once, come first. After j sweeps a state is what j
  intervals make of the guess, which is right if the plant forgets within j intervals. Sweeps also follow a step that
  does not halve the residuals; one that leads out of the finite numbers is taken back.
- A window of the trajectory on which the method does not converge is halved. Its first states, which have converged,
  are kept.

Sources: Lim et al., *Parallelizing non-linear sequential models over the sequence length*, ICLR 2024 (DEER); Gonzalez
et al., *Towards scalable and stable parallelization of nonlinear RNNs*, NeurIPS 2024 (ELK). Note: ELK damps the steps
by a Kalman smoother, with a weight that is chosen for each system. Sweeps need no such weight, and no Jacobians.
"""

import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from rt_torchrl.plants.signal import differences
from rt_torchrl.trajectories.engines.compilation import marked_dynamic, plain
from rt_torchrl.trajectories.engines.interval import Drive, Interval
from rt_torchrl.trajectories.engines.linear_recurrence import linear_recurrence
from rt_torchrl.trajectories.engines.linearisation import as_one_batch, over_all, piece

SHORTEST = 128
"""Number of intervals below which no window is cut further: sweeps and steps would take as long as marching."""
COPIES = 4
"""Number of times that the Jacobians of a window are held: as they are, and by the reduction of the recurrence."""

_told: set[tuple[str, int]] = set()
"""Plants and horizons whose user has been told that they were marched."""


class Found(NamedTuple):
    """The first states of a window, which have converged; what remained of all residuals, and after how many steps."""

    states: Tensor
    residual: float
    iterations: int


class NewtonMarch:
    """Computes trajectories by Newton's method, and marches where it does not converge; the module describes it.

    Args:
        ends: Φ of many intervals at once, ``rows n_s``, as a function of interval, states and drive.
        linearise: its Jacobians, as :func:`~rt_torchrl.trajectories.engines.linearisation.linearise`.
        march: the recurrence itself.
        tolerance: greatest residual, as a share of the greatest absolute value that the state has had until then. A
            step from there must be within the square root of it, whose square is the error that is left.
        iterations: greatest number of evaluations of the residuals of a window.
        sweeps: number of sweeps in a row.
        memory: bytes that the Jacobians of a window may take.
        at_once: number of Jacobians by one call; None for the piece that a compiled graph is made for.
    """

    def __init__(
        self,
        ends: Callable[[Interval, Tensor, Drive], Tensor],
        linearise: Callable[[Interval, tuple[str, ...], Tensor, Drive], Tensor],
        march: Callable[[Interval, Tensor, Drive], Tensor],
        *,
        tolerance: float,
        iterations: int,
        sweeps: int,
        memory: float,
        at_once: int | None,
    ):
        self.ends, self.linearise, self.march = ends, linearise, march
        self.tolerance, self.iterations, self.sweeps = tolerance, iterations, sweeps
        self.memory, self.at_once = memory, at_once

    @torch.no_grad()
    def __call__(self, interval: Interval, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``.

        Warns once for a plant and a number of intervals if it had to march.
        """
        n, state, found, iterations = len(drive.t), initial_state, [initial_state.new_empty(0, *initial_state.shape)], 0
        done, length = 0, min(n, self.longest(initial_state))
        while done < n:
            window = _Window(interval, state, Drive(*(x[done : done + length] for x in drive)))
            states, residual, count = self._solved(window)
            found.append(states)
            done, iterations = done + len(states), iterations + count
            state = states[-1] if len(states) else state
            if len(states) == window.n:
                length = min(2 * length, self.longest(initial_state))
            elif window.n < 2 * SHORTEST:
                rest = self.march(interval, state, Drive(*(x[done:] for x in drive)))
                _tell(interval.plant.name, n, done, residual, iterations, rest)
                return torch.cat([*found, rest])
            else:
                length = window.n // 2
        return torch.cat(found)

    def longest(self, state: Tensor) -> int:
        """The number of intervals whose Jacobians the memory holds."""
        return max(1, int(self.memory / (COPIES * state.element_size() * state.numel() * state.shape[-1])))

    def _solved(self, window: "_Window") -> Found:
        """The first states of a window on which Newton's method converges."""
        guess = before_step = self._swept(window, window.state.expand(window.n, *window.state.shape))
        settled, size, last, count = guess[:0], math.inf, math.inf, 0
        while len(settled) < window.n and count < self.iterations:
            starts, count = window.starts(guess), count + 1
            ends = window.ends(self.ends, starts)
            residual, scale = differences(window.interval.plant.states, ends, guess), window.scale(ends)
            size = (residual.abs() / scale).amax().item()
            if not math.isfinite(size) and math.isinf(last):
                break  # sweeps alone lead out of the finite numbers
            if not size <= 0.5 * last:
                guess, last = self._swept(window, guess if math.isfinite(size) else before_step), math.inf
                continue
            linearise = partial(self.linearise, window.interval, ())
            jacobians = over_all(linearise, starts, window.drive, at_once=self.at_once)
            step = linear_recurrence(jacobians[1:], residual)
            close = (residual.abs() <= self.tolerance * scale) & (step.abs() <= self.tolerance**0.5 * scale)
            # The ends hold periodic states within their turn, which a sum of guess and step does not.
            before_step, guess, last = guess, ends + (step - residual), size
            settled = guess[: int(close.flatten(1).all(1).long().cumprod(0).sum())]
        return Found(settled, size, count)

    def _swept(self, window: "_Window", guess: Tensor) -> Tensor:
        for _ in range(min(self.sweeps, window.n)):
            guess = window.ends(self.ends, window.starts(guess))
        return guess


class _Window:
    """Intervals behind a state that is known.

    Args:
        interval: the map Φ.
        state: the state at the start, ``batch n_s``.
        drive: times and inputs of the intervals.
    """

    def __init__(self, interval: Interval, state: Tensor, drive: Drive):
        self.interval, self.state, self.drive, self.n = interval, state, drive, len(drive.t)
        self._rows = piece(*as_one_batch(state.expand(self.n, *state.shape), drive), 0, self.n * len(state))[1]
        for tensor in self._rows:
            marked_dynamic(tensor, 0)

    def starts(self, guess: Tensor) -> Tensor:
        """States at the starts of the intervals, from those at their ends."""
        return torch.cat([self.state.unsqueeze(0), guess[:-1]])

    def ends(self, function: Callable[[Interval, Tensor, Drive], Tensor], starts: Tensor) -> Tensor:
        """Φ of all intervals by one call."""
        rows = marked_dynamic(plain(starts.flatten(0, 1)), 0)
        return function(self.interval, rows, self._rows).unflatten(0, starts.shape[:2])

    def scale(self, ends: Tensor) -> Tensor:
        """The greatest absolute value of each state until the end of each interval."""
        least = torch.finfo(ends.dtype).tiny  # a state that rests at zero
        return torch.cat([self.state.unsqueeze(0), ends]).abs().cummax(0).values[1:].clamp(min=least)


def _tell(plant: str, n: int, done: int, residual: float, iterations: int, rest: Tensor) -> None:
    """Warn that the rest was marched, unless the plant has diverged, which the caller reports."""
    if (plant, n) in _told or not rest.isfinite().all():
        return
    _told.add((plant, n))
    warnings.warn(
        f"engine 'parallel_in_time' marched intervals {done + 1} to {n} of plant {plant!r}: their residual was "
        f"{residual:.2g} after {iterations} iterations of Newton's method. The result is that of engine 'parallel', "
        "which is quicker here.",
        stacklevel=2,
    )
