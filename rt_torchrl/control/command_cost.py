r"""The cost of held commands and its exact gradient, and its bounded descent.

.. math::
    J(u) = \frac1N\sum_{k<N}\Big(L_a(t_k, s_k, a_k, z_k)
        + w\sum_i\Big(\frac{c_{k,i} - a_{k,i}}{h_i - l_i}\Big)^2\Big)
        + \frac{\Phi_a(s_N) - \Phi_a(s_0)}{N\Delta t}, \qquad
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

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.policies import SmoothClip
from rt_torchrl.trajectories.engines.code import IntervalCode, code_of, signals_of
from rt_torchrl.trajectories.engines.interval import Drive
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.rollout import require_double

Plan = Float[np.ndarray, "m n_a"]
"""Held commands u in [0, 1] of a window."""
PENALTY = 1.0
"""Weight w of the penalty, in units of L_a."""
DIVERGED = 1e6
"""Cost of a trial that diverges, in costs of the start: greater than any that a line search accepts."""
PAIRS = 10
"""Number of pairs that approximate the curvature in a descent."""


class PenalisedInterval(nn.Module):
    """A control interval whose state (s, J) also sums L_a, what Φ_a/Δt gains, and the penalty.

    Its drive holds commands in [0, 1].

    Args:
        plant: the physics, whose actions have finite ranges.
        closure: closure of the system, which asks for no gradients.
    """

    def __init__(self, plant: Plant, closure: nn.Module):
        super().__init__()
        self.plant, self.closure = plant, closure
        ranges = SmoothClip(plant.actions)  # which refuses infinite ones
        self.low = ranges.low
        self.span = nn.Buffer(ranges.high - ranges.low)

    def forward(self, state: Tensor, drive: Drive) -> Tensor:
        """State and cost, (s, J), at the end of the interval."""
        s, command = state[..., :-1], self.low + self.span * drive.command
        applied = self.plant.actuate(s, command)
        excess = ((command - applied) / self.span).square().sum(-1)
        cost = self.plant.running_cost(drive.t, s, applied, drive.exogenous) + PENALTY * excess
        end = self.plant.step(drive.t, s, command, drive.exogenous, self.closure).state
        cost = cost + (self.plant.terminal_cost(end) - self.plant.terminal_cost(s)) / self.plant.dt
        return torch.cat([end, (state[..., -1] + cost).unsqueeze(-1)], -1)


class CommandCost:
    """J of commands over a window, with its gradient in one call; :meth:`begin` says where the window begins.

    The machine code of the engine ``native`` works on arrays that are kept between calls, because a window of some
    tens of intervals takes less time than a few operations on tensors.

    Args:
        plant: the physics.
        closure: closure of the system.
        n: number N of control intervals of the window.
        hold: number m of control intervals for which a command is held; the last may be held for fewer.

    Raises:
        ValueError: if an action has no finite range, episodes of the plant may end early, or a weight is not in double
            precision.
    """

    def __init__(self, plant: Plant, closure: nn.Module, n: int, *, hold: int = 1):
        require_double("closure", closure)
        self.interval = PenalisedInterval(plant, closure)
        if plant.end_cost is not None:
            raise ValueError(
                f"episodes of plant {plant.name!r} may end early, which optimal commands do not consider: leave out "
                "model predictive control."
            )
        self.plant, self.n, self.hold = plant, n, hold
        self._first = np.arange(0, n, hold)
        self._code: IntervalCode | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of a plan: its number m of held commands, and the number of actions."""
        return len(self._first), len(self.plant.actions)

    def commands(self, plan: Plan) -> Float[Tensor, "n n_a"]:
        """The commands of all n intervals, in their own units."""
        return self.interval.low + self.interval.span * torch.from_numpy(self._repeated(plan))

    def _repeated(self, plan: Plan) -> Float[np.ndarray, "n n_a"]:
        return np.repeat(plan, self.hold, 0)[: self.n]

    def begin(self, state: Float[Tensor, " n_s"], exogenous: Float[Tensor, "n n_z"], *, start: float = 0.0) -> None:
        """Set the window: its initial state, exogenous inputs and the time of its start [s]."""
        t = start + self.plant.dt * torch.arange(self.n, dtype=torch.float64).unsqueeze(-1)
        command = exogenous.new_full((self.n, 1, len(self.plant.actions)), 0.5)
        self._state = torch.nn.functional.pad(state, (0, 1)).unsqueeze(0)
        self._drive = Drive(t, exogenous.unsqueeze(1), command)
        with torch.enable_grad():
            traced = code_of(self.interval, self._state, self._drive._replace(command=command.clone().requires_grad_()))
        self._code = None
        if traced is not None:  # kept code, unless the plant or the closure is another one by now
            self._code, inputs = traced
            self._lay_out(self._code, inputs.row())

    def _lay_out(self, code: IntervalCode, weights: np.ndarray) -> None:
        """Lay out the arrays of the window. The window fills all lanes of the processor, of which the first is read."""
        n, n_s, n_x, lanes = self.n, self._state.shape[1], code.sizes["x"], code.lanes.number
        x = torch.cat([self._drive.t.unsqueeze(-1), self._drive.exogenous, self._drive.command], -1)
        self._x, self._states = x.numpy(), np.empty((n + 1, n_s, lanes))
        self._states[0] = self._state.numpy().T
        self._costate, self._by_drive = np.empty((n_s, lanes)), np.empty((n, n_x, lanes))
        driven = signals_of([x]), 0, 0
        adjoint = np.zeros((1, n_s, lanes)), 0, self._costate, weights, self._by_drive, np.zeros((0, lanes)), n
        self._march = code.march.bound(*driven, self._states, weights, n)
        self._sweep = code.sweeps[True].bound(*driven, self._states, *adjoint)

    def __call__(self, plan: Plan) -> tuple[float, Plan]:
        """J and its gradient by the commands u in [0, 1]."""
        if self._code is None:
            return self._by_torch(plan)
        n_a = len(self.plant.actions)
        self._x[:, 0, -n_a:] = self._repeated(plan)
        self._march()
        self._costate[:] = 0.0
        self._costate[-1] = 1.0
        self._sweep()
        by_plan = np.add.reduceat(self._by_drive[:, -n_a:, 0], self._first, 0)
        return float(self._states[-1, -1, 0]) / self.n, by_plan / self.n

    def _by_torch(self, plan: Plan) -> tuple[float, Plan]:
        """The same for a plant that cannot become machine code."""
        with torch.enable_grad():
            u = torch.from_numpy(plan).clone().requires_grad_()
            command = u.repeat_interleave(self.hold, 0)[: self.n].unsqueeze(1)
            ends = Native().end_states(self.interval, self._state, self._drive._replace(command=command))
            cost = ends[-1, 0, -1]
            (slope,) = torch.autograd.grad(cost, u)
        return cost.item() / self.n, slope.numpy() / self.n


class Minimum(NamedTuple):
    """The best point that a descent found, its cost and gradient."""

    point: np.ndarray
    cost: float
    gradient: np.ndarray


def descend(
    evaluate: Callable[[Float[np.ndarray, "..."]], tuple[float, Float[np.ndarray, "..."]]],
    start: Float[np.ndarray, "..."],
    *,
    iterations: int,
    tolerance: float,
) -> Minimum:
    """Minimise a cost over a box [0, 1] in all variables.

    The cost is divided by its value at the start, so that no parameter depends on a plant's units.

    Args:
        evaluate: function from a point to cost and gradient; a trial that is not finite counts as a bad one.
        start: first point, in the box.
        iterations: greatest number of iterations.
        tolerance: relative decrease of the cost in an iteration below which the descent stops.

    Raises:
        FloatingPointError: if the cost is not finite at the start.

    Source: Zhu, Byrd, Lu and Nocedal, ACM Trans. Math. Softw. 23 (1997) 550, in SciPy.
    """
    from scipy.optimize import fmin_l_bfgs_b  # here, because it takes a second to load and --help need not wait for it

    def finite(trial: Minimum) -> bool:
        return bool(np.isfinite(trial.cost) and np.isfinite(trial.gradient).all())

    best = Minimum(start, *evaluate(start))
    scale = abs(best.cost) or 1.0
    if not finite(best):
        raise FloatingPointError("the cost or its gradient is not finite at the start of the descent.")

    def objective(flat: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best
        trial = best
        if not (flat == trial.point.ravel()).all():  # L-BFGS-B begins at the start, whose cost is known
            point = flat.reshape(start.shape)
            trial = Minimum(point.copy(), *evaluate(point))
            if not finite(trial):
                return DIVERGED, np.zeros_like(flat)
            if trial.cost < best.cost:
                best = trial
        return trial.cost / scale, trial.gradient.ravel() / scale

    with _libraries().limit(limits=1, user_api="blas"):
        fmin_l_bfgs_b(  # ``minimize`` converts the bounds two times more, in a tenth of a solve of a short window
            objective,
            start.ravel(),
            bounds=[(0.0, 1.0)] * start.size,
            m=PAIRS,
            factr=tolerance / np.finfo(float).eps,
            pgtol=0.0,
            maxiter=iterations,
            maxfun=2 * iterations + 20,
        )
    return best


@functools.cache
def _libraries() -> Any:
    """The linear algebra of NumPy and SciPy.

    L-BFGS-B takes scalar products of thousands of numbers. Two threads wait for each other in each of them, and on a
    machine with other work they wait for milliseconds.
    """
    from threadpoolctl import ThreadpoolController  # after SciPy, whose libraries it finds

    return ThreadpoolController()
