"""Model predictive control: the best commands over a horizon by bounded descent, planned again every period."""

import functools
import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.control.command_cost import PENALTY, CommandCost, TerminalCost
from rt_torchrl.control.forecasts import Forecast, Futures, Held
from rt_torchrl.interruption import safe_point
from rt_torchrl.options import check_options
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import constant

DIVERGED = 1e6
"""Cost of a trial that diverges, in costs of the start: greater than any that a line search accepts."""
Tail = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Function from end times ``batch``, states ``batch n_s`` and inputs ``batch n_z`` there to a cost V ``batch``."""


@dataclass(frozen=True, kw_only=True)
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

    iterations: int = 1000
    tolerance: float = 1e-10
    gradient: float = 1e-8
    memory: int = 20

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("iterations", "memory"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} of the descent must be at least 1.")
        for argument in ("tolerance", "gradient"):
            if not getattr(self, argument) >= 0.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the descent must not be negative.")


class Minimum(NamedTuple):
    """The best point that a descent found, its cost and gradient, and the number of evaluations."""

    point: np.ndarray
    cost: float
    gradient: np.ndarray
    evaluations: int


class _Seen:
    """The function that L-BFGS-B calls; it remembers the best point."""

    def __init__(self, evaluate: Callable[[np.ndarray], tuple[float, np.ndarray]], start: np.ndarray):
        self._evaluate, self._shape = evaluate, start.shape
        cost, gradient = evaluate(start)
        if not (np.isfinite(cost) and np.isfinite(gradient).all()):
            raise FloatingPointError("the cost or its gradient is not finite at the start of the descent.")
        self.best, self._scale, self._first = Minimum(start, cost, gradient, 1), abs(cost) or 1.0, True
        self.count = 1

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        if self._first and (flat == self.best.point.ravel()).all():  # L-BFGS-B begins at the start
            cost, gradient = self.best.cost, self.best.gradient
        else:
            point = flat.reshape(self._shape)
            cost, gradient = self._evaluate(point)
            self.count += 1
            if not (np.isfinite(cost) and np.isfinite(gradient).all()):
                return DIVERGED, np.zeros_like(flat)
            if cost < self.best.cost:
                self.best = Minimum(point.copy(), cost, gradient, self.count)
        self._first = False
        return cost / self._scale, gradient.ravel() / self._scale


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


@dataclass(frozen=True, kw_only=True)
class RecedingHorizonConfig:
    """Parameters of model predictive control.

    Args:
        horizon: length of the window over which a plan is made [s].
        period: time between two plans [s]; None for the time that a command is held.
        hold: time for which a command of a plan is held [s]; None for a control interval.
        ends: whether a window ends with the episode, whose last intervals cost nothing after it; otherwise it rolls on.
        penalty: weight of (command − applied)² over the squared range, in units of L_a; see :class:`CommandCost`.
        iterations: greatest number of iterations of L-BFGS-B in a solve.
        tolerance: relative decrease of the cost in an iteration below which a solve ends.
        memory: number of pairs that approximate the curvature.
        deadline: longest wall-clock time of a solve [s]; after it the last plan goes on.

    Raises:
        ValueError: if a number is out of its range.
    """

    horizon: float
    period: float | None = None
    hold: float | None = None
    ends: bool = False
    penalty: float = PENALTY
    iterations: int = 20
    tolerance: float = 1e-4
    memory: int = 10
    deadline: float = math.inf

    def __post_init__(self) -> None:
        check_options(self, infinite=("deadline",))
        for argument in ("horizon", "period", "hold", "deadline"):
            value = getattr(self, argument)
            if value is not None and not value > 0.0:
                raise ValueError(f"{argument}={value} s of the receding horizon must be positive.")
        if not self.penalty >= 0.0:
            raise ValueError(f"penalty={self.penalty} of the receding horizon must not be negative.")
        self.descent()  # which has ranges of its own

    def descent(self) -> BoundedDescentConfig:
        """The parameters of a solve."""
        return BoundedDescentConfig(
            iterations=self.iterations, tolerance=self.tolerance, gradient=0.0, memory=self.memory
        )


class SharedCommands:
    r"""The mean cost of several futures, which share the commands until the next plan, and its gradient, as one point.

    .. math:: J = \frac1S\sum_{i\le S} J_i(u_0, \dots, u_{p-1}, u^{(i)}_p, \dots, u^{(i)}_{m-1})

    At the next plan the input is measured again, so that the later commands are those of one future each. A plan whose
    commands are shared to the end cannot answer what comes, and is too cautious; a plan for one future is too bold.

    Args:
        cost: cost of each future, one realisation of its window each.
        shared: number p of held commands that all futures share, at least 1.

    Source: Lucia, Finkler and Engell, J. Process Control 23 (2013) 1306, with a tree that branches once.
    """

    def __init__(self, cost: CommandCost, shared: int):
        self.cost, self.shared = cost, shared

    def point(self, plans: Float[np.ndarray, "n_futures m n_a"]) -> Float[np.ndarray, "variables n_a"]:
        """The variables of a plan for each future; where they must share commands, the means."""
        first = plans[:, : self.shared].mean(0)
        return np.concatenate([first, plans[:, self.shared :].reshape(-1, plans.shape[-1])])

    def plans(self, point: Float[np.ndarray, "variables n_a"], count: int) -> Float[np.ndarray, "{count} m n_a"]:
        """The plan of each of ``count`` futures; p is less where the window is shorter."""
        if count == 1:
            return point[None]
        n_a = point.shape[-1]
        shared = min(len(point), self.shared)
        first = np.broadcast_to(point[:shared], (count, shared, n_a))
        return np.concatenate([first, point[shared:].reshape(count, -1, n_a)], 1)

    def __call__(
        self, point: Float[np.ndarray, "variables n_a"], count: int
    ) -> tuple[float, Float[np.ndarray, "variables n_a"]]:
        """J and its gradient by the variables of ``count`` futures."""
        costs, slopes = self.cost(self.plans(point, count))
        if count == 1:
            return float(costs[0]), slopes[0]
        first = slopes[:, : self.shared].sum(0)
        slope = np.concatenate([first, slopes[:, self.shared :].reshape(-1, slopes.shape[-1])])
        return float(costs.mean()), slope / count


class Solve(NamedTuple):
    """One solve of model predictive control.

    Args:
        seconds: wall-clock time [s].
        gradients: number of gradients.
        late: whether the deadline passed, so that the last plan went on.
        diverged: whether the model diverged under the last plan, so that this or a constant command went on.
    """

    seconds: float
    gradients: int
    late: bool
    diverged: bool = False


class _LateError(Exception):
    """The deadline of a solve has passed."""


class RecedingHorizon:
    r"""Plans commands over a horizon by L-BFGS-B on exact gradients, and acts by the first ones until the next plan.

    .. math:: \min_{c}\ \int_t^{t+H} L_a\,dt' + V(s(t + H)) \quad\text{from the measured state, under a forecast of z}

    Under a forecast with several futures the integral is the mean over them. They share the commands until the next
    plan; later ones answer what has come by then, see :class:`SharedCommands`.

    Every plan starts from the rest of the last one, whose end is held. The first plan of an episode starts from the
    best constant command and has no deadline, because there is no plan to go on with; :meth:`prepare` makes one before
    the episode begins, so that the first solve has a deadline too.

    Args:
        plant: the physics of the model.
        closure: closure of the model; a twin's closure may be trained while the controller acts.
        config: parameters.
        forecast: forecast of the exogenous inputs; None holds what is measured.
        terminal: cost V after the horizon, of the end states ``batch n_s``, in units of L_a·s; None for none. A window
            that ends with the episode has the plant's ``terminal_cost`` instead.
        tail: the cost V where it also depends on the time and on the inputs after the window, of several futures on
            their mean; None for none.

    Raises:
        ValueError: if horizon, period and hold are no whole multiples of each other, or of the control interval.
    """

    def __init__(
        self,
        plant: Plant,
        closure: nn.Module,
        config: RecedingHorizonConfig,
        *,
        forecast: Forecast | None = None,
        terminal: TerminalCost | None = None,
        tail: Tail | None = None,
    ):
        self.plant, self.config = plant, config
        self.forecast: Forecast = forecast or Held()
        hold = self._whole("hold", plant.dt if config.hold is None else config.hold, 1)
        self.horizon = self._whole("horizon", config.horizon, hold)
        self.period = hold if config.period is None else self._whole("period", config.period, hold)
        if self.period > self.horizon:
            raise ValueError(f"period={config.period} s must not be longer than horizon={config.horizon} s.")
        self.cost = CommandCost(plant, constant(closure), hold=hold, penalty=config.penalty, terminal=terminal)
        self._terminal, self._tail = terminal, tail
        self._shared = SharedCommands(self.cost, self.period // hold)
        self._prepared: np.ndarray | None = None
        self.solves: list[Solve] = []
        self.begin()

    def _whole(self, argument: str, seconds: float, multiple: int) -> int:
        """A time in control intervals, which is a whole multiple of others."""
        unit = multiple * self.plant.dt
        count = round(seconds / unit)
        if count < 1 or abs(count * unit - seconds) > 1e-6 * unit:
            raise ValueError(f"{argument}={seconds} s must be a whole multiple of {unit:g} s.")
        return count * multiple

    def begin(self) -> None:
        """Begin new episodes; what :meth:`prepare` has planned stays."""
        self._plans: list[np.ndarray] = []
        self._commands: Tensor | None = None

    def prepare(self, state: Float[Tensor, "1 n_s"], exogenous: Float[Tensor, "1 n_z"]) -> None:
        """Plan before episodes begin, so that their first solves have a plan to go on with when they are late.

        The plan is one more start of the first solves. The first call also makes the machine code, which takes seconds.

        Args:
            state: state that is typical of the beginning of an episode.
            exogenous: typical measured inputs.

        Raises:
            DivergenceError: if the model diverges under every constant command.
        """
        self._prepared = None
        self.begin()
        self.plan(0.0, state, exogenous)
        self._prepared = self._plans[0]
        self.begin()

    def plan(
        self, t: float, state: Float[Tensor, "batch n_s"], exogenous: Float[Tensor, "batch n_z"]
    ) -> Float[Tensor, "batch n n_a"]:
        """Plan anew and return the commands of the whole window.

        Args:
            t: present time [s], in the episode.
            state: measured states of the episodes.
            exogenous: measured inputs.

        Raises:
            DivergenceError: if the model diverges under every start of a first plan.
        """
        k = round(t / self.plant.dt)
        n = min(self.horizon, self.plant.n_steps - k) if self.config.ends else self.horizon
        ends = self.config.ends and k + n == self.plant.n_steps
        self.cost.terminal = self.plant.terminal_cost if ends else self._terminal
        inputs = self._futures(t, exogenous, n)
        first, found = not self._plans, []
        for episode in range(len(state)):
            safe_point()
            begins, coming = state[episode].expand(inputs.shape[1], -1), inputs[episode]
            began = time.perf_counter()
            if self._tail is not None and not ends:
                self.cost.terminal = self._tail_at(t + n * self.plant.dt, coming[:, -1].mean(0))
            self.cost.begin(begins, coming, start=t)
            last = self._prepared if first else self._shifted(self._plans[episode])
            starts = ([] if last is None else [last]) + (self._constants() if first else [])
            start = starts[0] if len(starts) == 1 else self._cheapest(starts)
            found.append(self._solved(start, last, began))
        self._plans = found
        return self.cost.commands(np.stack([plans.mean(0) for plans in found]), n)

    def _futures(
        self, t: float, exogenous: Float[Tensor, "batch n_z"], n: int
    ) -> Float[Tensor, "batch n_futures {n} n_z"]:
        """The futures that count; most forecasts know one."""
        if isinstance(self.forecast, Futures):
            return self.forecast.futures(t, exogenous, n)
        return self.forecast(t, exogenous, n).unsqueeze(1)

    def _tail_at(self, t: float, exogenous: Float[Tensor, " n_z"]) -> TerminalCost:
        """The tail as a function of the end states alone."""
        tail = self._tail
        assert tail is not None
        return lambda state: tail(state.new_full((len(state),), t), state, exogenous.expand(len(state), -1))

    def _solved(self, start: np.ndarray, last: np.ndarray | None, began: float) -> np.ndarray:
        """The plans for the futures of an episode; if it is late or diverges, the last ones go on, if there are any."""
        count, deadline = 0, math.inf if last is None else self.config.deadline

        def evaluate(point: np.ndarray) -> tuple[float, np.ndarray]:
            nonlocal count
            if time.perf_counter() - began > deadline:
                raise _LateError
            count += 1
            cost, gradient = self._shared(point[0], len(start))
            return cost, gradient[None]

        late = diverged = False
        try:
            best = descend(evaluate, self._shared.point(start)[None], self.config.descent()).point[0]
            found = self._shared.plans(best, len(start))
        except _LateError:
            found, late = start, True
        except FloatingPointError as error:
            if last is None:
                raise DivergenceError(f"plant {self.plant.name!r} diverges in every first plan: {error}") from error
            # A constant command goes on where the model diverges under the last plan too.
            found, diverged = self._cheapest([last, *self._constants()]), True
        self.solves.append(Solve(time.perf_counter() - began, count, late, diverged))
        return found

    def _shifted(self, plans: np.ndarray) -> np.ndarray:
        """The rest of the last plans, whose ends are held for as long as the window needs."""
        blocks, passed = self.cost.blocks(self.cost.n), self.period // self.cost.hold
        return plans[:, np.minimum(np.arange(passed, passed + blocks), plans.shape[1] - 1)]

    def _constants(self) -> list[np.ndarray]:
        """Constant commands at both ends and the middle of every range."""
        shape = self.cost.count, self.cost.blocks(self.cost.n), len(self.plant.actions)
        return [np.full(shape, levels) for levels in itertools.product((0.0, 0.5, 1.0), repeat=shape[-1])]

    def _cheapest(self, plans: Sequence[np.ndarray]) -> np.ndarray:
        """The plan of the least cost; one that diverges costs more than any other, and the first is taken if all do."""
        costs = [self._shared(self._shared.point(plan), len(plan))[0] for plan in plans]
        return plans[int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))]

    def act(
        self, t: float, state: Float[Tensor, "batch n_s"], exogenous: Float[Tensor, "batch n_z"]
    ) -> Float[Tensor, "batch n_a"]:
        """The command of the control interval at t [s], which follow each other; every period it plans."""
        k = round(t / self.plant.dt) % self.period
        if k == 0 or self._commands is None:
            self._commands = self.plan(t, state, exogenous)
        return self._commands[:, k]

    @torch.no_grad()
    def fly(
        self,
        initial_state: Float[Tensor, "batch n_s"],
        exogenous: Float[Tensor, "batch n n_z"],
        closure: nn.Module | None = None,
        *,
        plant: Plant | None = None,
    ) -> Trajectory:
        """Episodes of a system, side by side.

        Args:
            initial_state: initial states of the episodes.
            exogenous: exogenous inputs, of which each solve sees the present one.
            closure: closure of the system; None for that of ``plant``.
            plant: physics of the system; None for that of the model.
        """
        plant = self.plant if plant is None else plant
        system = Rollout(plant, plant.closure if closure is None else closure)
        self.begin()
        state, states, actions = initial_state, [initial_state.unsqueeze(1)], []
        for k in range(0, exogenous.shape[1], self.period):
            t, inputs = k * self.plant.dt, exogenous[:, k : k + self.period]
            read = state[:, : len(self.plant.states)]  # the system may have more than the model knows
            command = self.plan(t, read, exogenous[:, k])[:, : inputs.shape[1]]
            flown = system(state, inputs, command, start=t)
            states.append(flown.states[:, 1:])
            actions.append(flown.actions)
            state = flown.states[:, -1]
        return Trajectory(torch.cat(states, 1), torch.cat(actions, 1), exogenous)
