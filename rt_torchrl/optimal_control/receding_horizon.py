"""Model predictive control: the best commands over a horizon, planned again every period."""

import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.interruption import safe_point
from rt_torchrl.optimal_control.bounded_descent import BoundedDescentConfig, descend
from rt_torchrl.optimal_control.command_cost import PENALTY, CommandCost, TerminalCost
from rt_torchrl.optimal_control.forecasts import Forecast, Held
from rt_torchrl.options import check_options
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import constant

Guess = Callable[[Tensor, Tensor], Tensor]
"""Function from states ``batch n_s`` and forecast inputs ``batch n n_z`` to commands ``batch n n_a``."""


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


class Solve(NamedTuple):
    """Wall-clock time of a solve [s], its gradients, and whether it was late, so that the last plan went on."""

    seconds: float
    gradients: int
    late: bool


class _LateError(Exception):
    """The deadline of a solve has passed."""


class RecedingHorizon:
    r"""Plans commands over a horizon by L-BFGS-B on exact gradients, and acts by the first ones until the next plan.

    .. math:: \min_{c}\ \int_t^{t+H} L_a\,dt' + V(s(t + H)) \quad\text{from the measured state, under a forecast of z}

    Every plan starts from the rest of the last one, whose end is held. The first plan of an episode starts from the
    best constant command and has no deadline, because there is no plan to go on with.

    Args:
        plant: the physics of the model.
        closure: closure of the model; a twin's closure may be trained while the controller acts.
        config: parameters.
        forecast: forecast of the exogenous inputs; None holds what is measured.
        terminal: cost V after the horizon, of the end states ``batch n_s``, in units of L_a·s; None for none. A window
            that ends with the episode has none.
        guess: commands that a solve starts from where they cost less than the rest of the last plan, such as those of a
            classical controller on the model; None for none.

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
        guess: Guess | None = None,
    ):
        self.plant, self.config, self.guess = plant, config, guess
        self.forecast: Forecast = forecast or Held()
        hold = self._whole("hold", plant.dt if config.hold is None else config.hold, 1)
        self.horizon = self._whole("horizon", config.horizon, hold)
        self.period = hold if config.period is None else self._whole("period", config.period, hold)
        if self.period > self.horizon:
            raise ValueError(f"period={config.period} s must not be longer than horizon={config.horizon} s.")
        self.cost = CommandCost(plant, constant(closure), hold=hold, penalty=config.penalty, terminal=terminal)
        self._terminal = terminal
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
        """Begin new episodes, in which there is no plan yet."""
        self._plans: list[np.ndarray] = []
        self._commands: Tensor | None = None

    def plan(
        self, t: float, state: Float[Tensor, "batch n_s"], exogenous: Float[Tensor, "batch n_z"]
    ) -> Float[Tensor, "batch n n_a"]:
        """Plan anew and return the commands of the whole window.

        Args:
            t: present time [s], in the episode.
            state: measured states of the episodes.
            exogenous: measured inputs.

        Raises:
            DivergenceError: if the model diverges under the plan that a solve starts from.
        """
        k = round(t / self.plant.dt)
        n = min(self.horizon, self.plant.n_steps - k) if self.config.ends else self.horizon
        ends = self.config.ends and k + n == self.plant.n_steps
        self.cost.terminal = self.plant.terminal_cost if ends else self._terminal
        inputs = self.forecast(t, exogenous, n)
        first = not self._plans
        found = []
        for episode in range(len(state)):
            safe_point()
            one = slice(episode, episode + 1)
            began = time.perf_counter()
            self.cost.begin(state[one], inputs[one], start=t)
            start = self._best_constant() if first else self._shifted(self._plans[episode])
            if self.guess is not None:
                guessed = self.cost.units(self.guess(state[one], inputs[one]))[0]
                start = self._cheapest([start, guessed])
            found.append(self._solved(start, began, math.inf if first else self.config.deadline))
        self._plans = found
        return self.cost.commands(np.stack(found), n)

    def _solved(self, start: np.ndarray, began: float, deadline: float) -> np.ndarray:
        """The plan of one episode; late, it is the start."""
        count = 0

        def evaluate(point: np.ndarray) -> tuple[float, np.ndarray]:
            nonlocal count
            if time.perf_counter() - began > deadline:
                raise _LateError
            count += 1
            costs, gradient = self.cost(point)
            return float(costs[0]), gradient

        try:
            found, late = descend(evaluate, start[None], self.config.descent()).point[0], False
        except _LateError:
            found, late = start, True
        except FloatingPointError as error:
            raise DivergenceError(
                f"plant {self.plant.name!r} diverges in the plan from its last one: {error}"
            ) from error
        self.solves.append(Solve(time.perf_counter() - began, count, late))
        return found

    def _shifted(self, plan: np.ndarray) -> np.ndarray:
        """The rest of the last plan, whose end is held for as long as the window needs."""
        blocks, passed = self.cost.blocks(self.cost.n), self.period // self.cost.hold
        return plan[np.minimum(np.arange(passed, passed + blocks), len(plan) - 1)]

    def _best_constant(self) -> np.ndarray:
        """The constant commands of the least cost, of both ends and the middle of every range."""
        blocks, n_a = self.cost.blocks(self.cost.n), len(self.plant.actions)
        tried = [np.full((blocks, n_a), levels) for levels in itertools.product((0.0, 0.5, 1.0), repeat=n_a)]
        return self._cheapest(tried)

    def _cheapest(self, plans: Sequence[np.ndarray]) -> np.ndarray:
        """The plan of the least cost; one that diverges costs more than any other."""
        costs = [float(self.cost(plan[None])[0][0]) for plan in plans]
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
    ) -> Trajectory:
        """Episodes of a system with the closure, side by side; None takes the plant's own closure."""
        system = Rollout(self.plant, self.plant.closure if closure is None else closure)
        self.begin()
        state, states, actions = initial_state, [initial_state.unsqueeze(1)], []
        for k in range(0, exogenous.shape[1], self.period):
            t, inputs = k * self.plant.dt, exogenous[:, k : k + self.period]
            command = self.plan(t, state, exogenous[:, k])[:, : inputs.shape[1]]
            flown = system(state, inputs, command, start=t)
            states.append(flown.states[:, 1:])
            actions.append(flown.actions)
            state = flown.states[:, -1]
        return Trajectory(torch.cat(states, 1), torch.cat(actions, 1), exogenous)
