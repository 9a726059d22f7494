"""Model predictive control: the best commands over a horizon by bounded descent, planned again every period."""

import copy
import itertools
import math
import statistics
import time
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from rt_torchrl.control.command_cost import CommandCost, Plan, descend
from rt_torchrl.control.forecasts import Decaying, Forecast, held
from rt_torchrl.interruption import safe_point
from rt_torchrl.options import AtLeastOne, NotNegative, Positive, configuration
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.sampling import whole_multiple
from rt_torchrl.plants.shapes import Action, Actions, Input, Inputs, Starts, State
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import constant


@configuration
class PredictiveConfig:
    """Parameters of model predictive control.

    Args:
        horizon: length of the window over which a plan is made [s]; None for 20 held commands, or for a quarter of the
            plant's episode where that is shorter.
        period: time between two plans [s]; None for ``hold``.
        hold: time for which a command is held [s]; None for the plant's control interval.
        iterations: greatest number of iterations of L-BFGS-B in a solve.
        tolerance: relative decrease of the cost in an iteration below which a solve ends.
        forecast: forecast of the exogenous inputs of :class:`PredictiveControl`: held for the measured ones, or
            decaying to the mean of the inputs met so far with the time that fits them best; until inputs have been met,
            they are held.

    Raises:
        ValueError: if a number is out of its range.
    """

    horizon: Positive | None = None
    period: Positive | None = None
    hold: Positive | None = None
    iterations: AtLeastOne = 20
    tolerance: NotNegative = 1e-4
    forecast: Literal["held", "decaying"] = "decaying"
    virtual_episodes: ClassVar[int] = 3
    """Number of virtual episodes in each of the steps 5 and 6; each takes as long as all solves of a real episode."""

    def length(self, plant: Plant) -> float:
        """Length of the window of a plant [s]."""
        if self.horizon is not None:
            return self.horizon
        hold = self.hold or plant.dt
        return hold * max(1, min(20, math.floor(0.25 * plant.horizon / hold + 1e-9)))


class Solve(NamedTuple):
    """One solve of model predictive control.

    Args:
        seconds: wall-clock time [s].
        diverged: whether the model diverged under the last plan, so that this or a constant command went on.
    """

    seconds: float
    diverged: bool


class RecedingHorizon:
    r"""Plans commands over a horizon by L-BFGS-B on exact gradients, and acts by the first ones until the next plan.

    .. math:: \min_{c}\ \int_t^{t+H} L_a\,dt' + \Phi_a(s_{t+H}) \quad\text{from what is measured, under a forecast of z}

    Every plan starts from the rest of the last one, whose end is held; the first plan of an episode starts from the
    best constant command.

    Args:
        plant: the physics of the model.
        closure: closure of the model; a twin's closure may be trained while the controller acts.
        config: parameters.
        forecast: forecast of the exogenous inputs; None holds what is measured.

    Raises:
        ValueError: if horizon, period and hold are no whole multiples of each other, or of the control interval.
    """

    def __init__(self, plant: Plant, closure: nn.Module, config: PredictiveConfig, *, forecast: Forecast | None = None):
        self.plant, self.config = plant, config
        self.forecast: Forecast = forecast or held
        hold = whole_multiple("hold", config.hold or plant.dt, plant.dt)
        self.horizon = hold * whole_multiple("horizon", config.length(plant), hold * plant.dt)
        self.period = hold * whole_multiple("period", config.period or hold * plant.dt, hold * plant.dt)
        if self.period > self.horizon:
            raise ValueError(f"period={config.period} s must not be longer than horizon={config.length(plant)} s.")
        self.cost = CommandCost(plant, constant(closure), self.horizon, hold=hold)
        self.solves: list[Solve] = []
        self.begin()

    def begin(self) -> None:
        """Begin new episodes."""
        self._plans: list[Plan] = []
        self._commands: Tensor | None = None
        self._planned = 0
        """Interval of the period in which the plan was made; one that takes over plans at once."""

    def plan(self, t: float, state: State, exogenous: Input) -> Actions:
        """Plan anew and return the commands of the whole window.

        Args:
            t: present time [s], in the episode.
            state: measured states of the episodes.
            exogenous: measured inputs.

        Raises:
            DivergenceError: if the model diverges under every start of a first plan.
        """
        first, plans = not self._plans, []
        for episode, coming in enumerate(self.forecast(t, exogenous, self.horizon)):
            safe_point()
            began = time.perf_counter()
            self.cost.begin(state[episode], coming, start=t)
            last = None if first else self._shifted(self._plans[episode])
            plans.append(self._solved(last, began))
        self._plans = plans
        return torch.stack([self.cost.commands(plan) for plan in plans])

    def _solved(self, last: Plan | None, began: float) -> Plan:
        """The plan of an episode; where the model diverges under the last plan, this or a constant command goes on."""
        start, config = self._cheapest(self._constants()) if last is None else last, self.config
        diverged = False
        try:
            plan = descend(self.cost, start, iterations=config.iterations, tolerance=config.tolerance).point
        except FloatingPointError as error:
            if last is None:
                raise DivergenceError(f"plant {self.plant.name!r} diverges in every first plan: {error}") from error
            plan, diverged = self._cheapest([last, *self._constants()]), True
        self.solves.append(Solve(time.perf_counter() - began, diverged))
        return plan

    def _shifted(self, plan: Plan) -> Plan:
        """The rest of the last plan, whose end is held for as long as the window needs."""
        passed = self.period // self.cost.hold
        return plan[np.minimum(np.arange(passed, passed + len(plan)), len(plan) - 1)]

    def _constants(self) -> list[Plan]:
        """Constant commands at both ends and the middle of every range."""
        shape = self.cost.shape
        return [np.full(shape, levels) for levels in itertools.product((0.0, 0.5, 1.0), repeat=shape[-1])]

    def _cheapest(self, plans: list[Plan]) -> Plan:
        """The plan of the least cost; one that diverges costs more than any other, and the first is taken if all do."""
        costs = [self.cost(plan)[0] for plan in plans]
        return plans[int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))]

    def act(self, t: float, state: State, exogenous: Input) -> Action:
        """The command of the control interval at t [s], which follow each other; every period it plans."""
        k = round(t / self.plant.dt) % self.period
        if k == 0 or self._commands is None:
            self._commands, self._planned = self.plan(t, state, exogenous), k
        return self._commands[:, k - self._planned]

    @torch.no_grad()
    def fly(
        self, initial_state: Starts, exogenous: Inputs, closure: nn.Module | None = None, *, plant: Plant | None = None
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
            measured, now = plant.sensed(state, exogenous[:, k])  # of a system with more than the model knows
            command = self.plan(t, measured[:, : len(self.plant.states)], now)[:, : inputs.shape[1]]
            flight = system(state, inputs, command, start=t)
            states.append(flight.states[:, 1:])
            actions.append(flight.actions)
            state = flight.states[:, -1]
        return Trajectory(torch.cat(states, 1), torch.cat(actions, 1), exogenous)


class PredictiveControl(nn.Module):
    """State feedback by :class:`RecedingHorizon`; see :class:`StateFeedback` for the methods.

    Its weights are those of the closure that it plans on, and it has no others; its buffers are those of its forecast.
    Before every episode it plans once from a typical state, which is a draw of the plant: the first plan also makes the
    machine code, which takes seconds.

    Args:
        plant: the physics of the model.
        closure: closure of the model, such as that of a twin, which is trained in place.
        config: parameters.

    Raises:
        ValueError: if :class:`RecedingHorizon` refuses the parameters, or the closure is not on the CPU.
    """

    virtual_episodes = PredictiveConfig.virtual_episodes

    def __init__(self, plant: Plant, closure: nn.Module, config: PredictiveConfig):
        super().__init__()
        self.closure = closure
        devices = {str(weight.device) for weight in (*closure.parameters(), *closure.buffers())} - {"cpu"}
        if devices:
            raise ValueError(f"closure is on {', '.join(devices)}; model predictive control needs it on the CPU.")
        forever = torch.full((len(plant.inputs),), math.inf, dtype=torch.float64)
        self.forecast = Decaying(torch.zeros_like(forever), forever, dt=plant.dt)  # which holds, until it has learned
        self._acting = RecedingHorizon(plant, closure, config, forecast=self.forecast)
        generator = torch.Generator().manual_seed(0)
        self._typical = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)[:, 0]

    def learn(self, records: Inputs) -> None:
        """Fit the forecast to inputs that have been met, if it is not to hold what is measured.

        Args:
            records: inputs of whole episodes.
        """
        plant = self._acting.plant
        if self._acting.config.forecast == "held" or not plant.inputs:
            return
        horizon = min(self._acting.horizon, records.shape[1] - 1) * plant.dt
        self.forecast.load_state_dict(Decaying.fitted(records, dt=plant.dt, horizon=horizon).state_dict())

    @property
    def solves(self) -> list[Solve]:
        """The solves since the beginning of the episode or the last report, without the one before its beginning."""
        return self._acting.solves

    def begin(self) -> None:
        self._acting.begin()
        self._acting.plan(0.0, *self._typical)
        self._acting.begin()
        self._acting.solves.clear()

    @torch.no_grad()
    def act(self, t: float, state: State, exogenous: Input) -> Action:
        return self._acting.act(t, state, exogenous)

    @torch.no_grad()
    def fly(
        self, initial_state: Starts, exogenous: Inputs, closure: nn.Module | None = None, *, plant: Plant | None = None
    ) -> Trajectory:
        # Beside the controller that acts, which may be in the middle of an episode.
        beside = RecedingHorizon(self._acting.plant, self.closure, self._acting.config, forecast=self.forecast)
        return beside.fly(initial_state, exogenous, closure, plant=plant)

    def report(self) -> dict[str, float]:
        """Wall-clock times of the solves since the last report [ms], and the number of those that diverged.

        Nothing if there was none, as in a window that failed before the next plan was due.
        """
        solves = self.solves.copy()
        self.solves.clear()  # an operation that is not reset begins no episode
        if not solves:
            return {}
        seconds = [solve.seconds for solve in solves]
        return {
            "solve_median": 1e3 * statistics.median(seconds),
            "solve_max": 1e3 * max(seconds),
            "diverged_solves": float(sum(solve.diverged for solve in solves)),
        }

    def forward(self, observation: Tensor) -> Tensor:
        """Refuse to be called as a policy.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            "model predictive control is no function of the observation, so that it cannot be called, traced or "
            "exported as a policy. Take the model-free policy, which learns from its records (--role model_free)."
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> "PredictiveControl":
        # The machine code of a solve cannot be copied.
        duplicate = PredictiveControl(self._acting.plant, copy.deepcopy(self.closure, memo), self._acting.config)
        duplicate.load_state_dict(self.state_dict())
        memo[id(self)] = duplicate
        return duplicate


def affordable(controller: nn.Module | None, count: int) -> int:
    """The number of virtual episodes in which a controller flies, of so many that are wanted.

    Every one of model predictive control takes as long as its solves.
    """
    return controller.virtual_episodes if isinstance(controller, PredictiveControl) else count
