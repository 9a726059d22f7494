r"""The cost of held commands and its exact gradient, and its bounded descent.

.. math::
    J(u) = \frac1N\sum_{k<N}\Big(L_a(t_k, s_k, a_k, z_k)
        + w\sum_i\Big(\frac{c_{k,i} - a_{k,i}}{h_i - l_i}\Big)^2\Big) + \frac{V(s_N)}{N\Delta t}, \qquad
    c_k = l + (h - l)\,u_{\lfloor k/m\rfloor}

The commands c lie between the ends l and h of their ranges, and each is held for m control intervals. A command beyond
a rate limit changes nothing, so that its gradient is zero and a descent ends there. The penalty w leads it back. An
action a that the actuators apply is itself a command that they apply at once, c = a. With a command for every interval
the penalty is therefore zero at an optimum and does not move it.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.options import AtLeastOne, NotNegative, configuration
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Actions, Inputs, Starts
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.engines.code import Group, IntervalCode, code_of, signals_of
from rt_torchrl.trajectories.engines.interval import Drive
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.rollout import require_double

TerminalCost = Callable[[Tensor], Tensor]
"""Function from the end states, ``batch n_s``, to the cost V after the window, ``batch``, in units of L_a·s."""
Plans = Float[np.ndarray, "batch m n_a"]
"""Held commands in [0, 1] of each realisation of a window."""
PENALTY = 1.0
"""Weight w of the penalty, in units of L_a."""
DIVERGED = 1e6
"""Cost of a trial that diverges, in costs of the start: greater than any that a line search accepts."""


class PenalisedInterval(nn.Module):
    """A control interval whose state (s, J) also sums L_a and the penalty; its drive holds commands in [0, 1].

    Args:
        plant: the physics, whose actions have finite ranges.
        closure: closure of the system, which asks for no gradients.
        penalty: weight w of the penalty.
    """

    low: Tensor
    span: Tensor

    def __init__(self, plant: Plant, closure: nn.Module, penalty: float = PENALTY):
        super().__init__()
        self.plant, self.closure = plant, closure
        low, high = bounds(plant.actions)
        self.register_buffer("low", low)
        self.register_buffer("span", high - low)
        # A weight is an input of the traced program, so that another penalty needs no other program.
        self.penalty = nn.Parameter(torch.tensor(penalty, dtype=torch.float64), requires_grad=False)

    def forward(self, state: Tensor, drive: Drive) -> Tensor:
        """State and cost, (s, J), at the end of the interval."""
        s, command = state[..., :-1], self.low + self.span * drive.command
        applied = self.plant.actuate(s, command)
        excess = ((command - applied) / self.span).square().sum(-1)
        cost = self.plant.running_cost(drive.t, s, applied, drive.exogenous) + self.penalty * excess
        end = self.plant.step(drive.t, s, command, drive.exogenous, self.closure).state
        return torch.cat([end, (state[..., -1] + cost).unsqueeze(-1)], -1)


class CommandCost:
    """J of commands over a window, with its gradient in one call; :meth:`begin` says where the window begins.

    The machine code of the engine ``native`` works on arrays that are kept between calls, because a window of some
    tens of intervals takes less time than a few operations on tensors.

    Args:
        plant: the physics.
        closure: closure of the system.
        hold: number m of control intervals for which a command is held.
        terminal: cost V after the window; None for none.

    Raises:
        ValueError: if an action has no finite range, episodes of the plant may end early, ``hold`` is
            below 1 or a weight is not in double precision.
    """

    def __init__(self, plant: Plant, closure: nn.Module, *, hold: int = 1, terminal: TerminalCost | None = None):
        require_double("closure", closure)
        low, high = bounds(plant.actions)
        unbounded = [a.name for a, span in zip(plant.actions, (high - low).tolist(), strict=True) if span == torch.inf]
        if unbounded:
            raise ValueError(
                f"actions {', '.join(unbounded)} of plant {plant.name!r} have no finite range; give them low and high."
            )
        if plant.end_cost is not None:
            raise ValueError(
                f"episodes of plant {plant.name!r} may end early, which optimal commands do not consider: leave out "
                "model predictive control and the limit of the cost (--limit-episodes 0)."
            )
        if hold < 1:
            raise ValueError(f"hold={hold} must be at least 1 control interval.")
        self.plant, self.hold, self.terminal = plant, hold, terminal
        self.interval = PenalisedInterval(plant, closure)
        self._low, self._span = low.numpy(), (high - low).numpy()
        self._code: IntervalCode | None = None

    @property
    def count(self) -> int:
        """Number of realisations of the window."""
        return len(self._state)

    @property
    def traced(self) -> bool:
        """Whether the plant has become machine code, after :meth:`begin`."""
        return self._code is not None

    def blocks(self, n: int) -> int:
        """Number of commands of a window of n control intervals; the last may be held for less time."""
        return -(-n // self.hold)

    def commands(self, unit: Plans, n: int) -> Actions:
        """The commands of all n intervals."""
        return torch.from_numpy(np.repeat(self._low + self._span * unit, self.hold, 1)[:, :n].copy())

    def units(self, commands: Actions) -> Plans:
        """The held commands in [0, 1] that are nearest to commands of all intervals: the means over the blocks."""
        first = np.arange(0, commands.shape[1], self.hold)
        counts = np.diff(np.append(first, commands.shape[1]))[:, None]
        held = np.add.reduceat(commands.detach().numpy(), first, 1) / counts
        return np.clip((held - self._low) / self._span, 0.0, 1.0)

    def begin(self, initial_state: Starts, exogenous: Inputs, *, start: float = 0.0) -> None:
        """Set the window: its initial states, exogenous inputs and the time of its start [s]."""
        n = exogenous.shape[1]
        t = start + self.plant.dt * torch.arange(n, dtype=torch.float64).unsqueeze(-1)
        state = torch.nn.functional.pad(initial_state, (0, 1))
        command = exogenous.new_full((n, len(state), len(self.plant.actions)), 0.5)
        self._state, self._drive, self.n = state, Drive(t, exogenous.transpose(0, 1), command), n
        with torch.enable_grad():
            found = code_of(self.interval, state, self._drive._replace(command=command.clone().requires_grad_()))
        self._code = None
        if found is not None:  # kept code, unless the plant or the closure is another one by now
            self._code, inputs = found
            self._weights = inputs.row()
            self._place(self._code)

    def _place(self, code: IntervalCode) -> None:
        """Lay out the arrays of the window, one set for each group of lanes."""
        lanes, batch = code.lanes.number, len(self._state)
        n, n_s, n_x = self.n, self._state.shape[1], code.sizes["x"]
        groups = [Group(first, min(first + lanes, batch), lanes) for first in range(0, batch, lanes)]
        if getattr(self, "_shape", None) != (n, batch):
            self._shape = n, batch
            self._x = np.empty((len(groups), n, n_x, lanes))
            self._states = np.empty((len(groups), n + 1, n_s, lanes))
            self._by_drive = np.empty((n, n_x, lanes))
            signals = (signals_of([torch.from_numpy(x.transpose(0, 2, 1))]) for x in self._x)
            self._driven = [(each, 0, lanes - 1, 0) for each in signals]
            self._costate, self._nothing = np.empty((n_s, lanes)), np.zeros((1, n_s, lanes))
            self._by_weights = np.zeros((0, lanes))
            self._first_block = np.arange(0, n, self.hold)
        adjoint = (self._nothing, 0, self._costate, self._weights, self._by_drive, self._by_weights, n)
        calls = [(*x, s) for x, s in zip(self._driven, self._states, strict=True)]
        self._march = [code.march.bound(*call, self._weights, n) for call in calls]
        self._sweeps = [code.sweeps[True].bound(*call, *adjoint) for call in calls]
        self._groups, first = groups, 1 + self._drive.exogenous.shape[-1]
        exogenous, state = self._drive.exogenous.numpy(), self._state.numpy()[None]
        for k, group in enumerate(groups):
            self._x[k, :, :1] = self._drive.t.numpy()[:, None]
            self._x[k, :, 1:first] = group.gather(exogenous)
            self._states[k, 0] = group.gather(state)[0]

    def __call__(self, unit: Plans) -> tuple[Float[np.ndarray, " batch"], Plans]:
        """J and its gradient by the commands u in [0, 1] of each realisation of the window."""
        if self._code is None:
            return self._by_torch(unit)
        costs, gradient = np.empty(len(unit)), np.empty_like(unit)
        for k, group in enumerate(self._groups):
            self._sweep(k, group, unit, costs, gradient)
        costs /= self.n
        gradient /= self.n
        return costs, gradient

    def _sweep(self, k: int, group: Group, unit: np.ndarray, costs: np.ndarray, gradient: np.ndarray) -> None:
        x, states, n, n_a = self._x[k], self._states[k], self.n, unit.shape[-1]
        lanes = group.gather(unit.transpose(1, 0, 2))
        x[:, -n_a:] = lanes if self.hold == 1 else np.repeat(lanes, self.hold, 0)[:n]
        self._march[k]()
        self._costate[:] = 0.0
        self._costate[-1] = 1.0
        costs[group.first : group.last] = states[-1, -1, : group.live]
        if self.terminal is not None:
            costs[group.first : group.last] += self._end(states[-1, :-1], group.live)
        self._sweeps[k]()
        by_blocks = self._by_drive[:, -n_a:]
        if self.hold > 1:
            by_blocks = np.add.reduceat(by_blocks, self._first_block, 0)
        gradient[group.first : group.last] = by_blocks[:, :, : group.live].transpose(2, 0, 1)

    def _end(self, ends: np.ndarray, live: int) -> np.ndarray:
        """V/Δt of the end states, whose gradient goes into the co-state."""
        assert self.terminal is not None
        with torch.enable_grad():
            end = torch.from_numpy(ends[:, :live].T.copy()).requires_grad_()
            value = self.terminal(end) / self.plant.dt
            # The terminal cost of most plants is a constant.
            slope = torch.autograd.grad(value.sum(), end)[0] if value.requires_grad else torch.zeros_like(end)
        self._costate[:-1, :live] = slope.numpy().T
        return value.detach().numpy()

    def _by_torch(self, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same for a plant that cannot become machine code."""
        with torch.enable_grad():
            u = torch.from_numpy(unit).clone().requires_grad_()
            command = u.repeat_interleave(self.hold, 1)[:, : self.n].transpose(0, 1)
            ends = Native(compiled=False).end_states(self.interval, self._state, self._drive._replace(command=command))
            cost = ends[-1, :, -1]
            if self.terminal is not None:
                cost = cost + self.terminal(ends[-1, :, :-1]) / self.plant.dt
            (slope,) = torch.autograd.grad(cost.sum(), u)
        return cost.detach().numpy() / self.n, slope.numpy() / self.n


@configuration
class BoundedDescentConfig:
    """How commands descend a cost.

    The cost is divided by its value at the start, so that no parameter depends on a plant's units.

    Args:
        iterations: greatest number of iterations.
        tolerance: relative decrease of the cost in an iteration below which the descent stops.
        gradient: greatest component of the projected gradient, of the relative cost, below which the descent stops.
        memory: number of pairs that approximate the curvature.

    Raises:
        ValueError: if a number is out of its range.
    """

    iterations: AtLeastOne = 1000
    tolerance: NotNegative = 1e-10
    gradient: NotNegative = 1e-8
    memory: AtLeastOne = 20


class Minimum(NamedTuple):
    """The best point that a descent found, its cost and gradient, and the number of evaluations."""

    point: np.ndarray
    cost: float
    gradient: np.ndarray
    evaluations: int


class _Seen:
    """The function that L-BFGS-B calls; it remembers the best point."""

    def __init__(self, evaluate: Callable[[np.ndarray], tuple[float, np.ndarray]], start: np.ndarray):
        self._evaluate, self.count = evaluate, 1
        cost, gradient = evaluate(start)
        if not (np.isfinite(cost) and np.isfinite(gradient).all()):
            raise FloatingPointError("the cost or its gradient is not finite at the start of the descent.")
        self.best, self._scale = Minimum(start, cost, gradient, 1), abs(cost) or 1.0

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        best = self.best
        # L-BFGS-B begins at the start, whose cost is known.
        if self.count > 1 or not (flat == best.point.ravel()).all():
            point = flat.reshape(best.point.shape)
            cost, gradient = self._evaluate(point)
            self.count += 1
            if not (np.isfinite(cost) and np.isfinite(gradient).all()):
                return DIVERGED, np.zeros_like(flat)
            best = Minimum(point.copy(), cost, gradient, self.count)
            if cost < self.best.cost:
                self.best = best
        return best.cost / self._scale, best.gradient.ravel() / self._scale


def descend(
    evaluate: Callable[[Float[np.ndarray, "..."]], tuple[float, Float[np.ndarray, "..."]]],
    start: Float[np.ndarray, "..."],
    config: BoundedDescentConfig,
) -> Minimum:
    """Minimise a cost over a box [0, 1] in all variables.

    Args:
        evaluate: function from a point to cost and gradient; a trial that is not finite counts as a bad one.
        start: first point, in the box.
        config: parameters of the descent.

    Raises:
        FloatingPointError: if the cost is not finite at the start.

    Source: Zhu, Byrd, Lu and Nocedal, ACM Trans. Math. Softw. 23 (1997) 550, in SciPy.
    """
    from scipy.optimize import fmin_l_bfgs_b  # here, because it takes a second to load and --help need not wait for it

    seen = _Seen(evaluate, start)
    with _libraries().limit(limits=1, user_api="blas"):
        fmin_l_bfgs_b(  # ``minimize`` converts the bounds two times more, in a tenth of a solve of a short window
            seen,
            start.ravel(),
            bounds=[(0.0, 1.0)] * start.size,
            m=config.memory,
            factr=config.tolerance / np.finfo(float).eps,
            pgtol=config.gradient,
            maxiter=config.iterations,
            maxfun=2 * config.iterations + 20,
        )
    return seen.best._replace(evaluations=seen.count)


@functools.cache
def _libraries() -> Any:
    """The linear algebra of NumPy and SciPy.

    L-BFGS-B takes scalar products of thousands of numbers. Two threads wait for each other in each of them, and on a
    machine with other work they wait for milliseconds.
    """
    from threadpoolctl import ThreadpoolController  # after SciPy, whose libraries it finds

    return ThreadpoolController()


def projected_gradient(
    point: Float[np.ndarray, "batch ..."], gradient: Float[np.ndarray, "batch ..."]
) -> Float[np.ndarray, " batch"]:
    """Norm of the part of the gradient that leads into the box [0, 1]; zero where no feasible direction descends."""
    outwards = ((point <= 0.0) & (gradient > 0.0)) | ((point >= 1.0) & (gradient < 0.0))
    inwards = np.where(outwards, 0.0, gradient)
    return np.sqrt(np.square(inwards).reshape(len(point), -1).sum(-1))
