"""Model predictive control that acts in the place of a policy, on a model whose closure may be trained meanwhile."""

import copy
import dataclasses
import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.control.forecasts import Decaying, Forecast, Held, Scattered
from rt_torchrl.control.receding_horizon import RecedingHorizon, RecedingHorizonConfig, Solve
from rt_torchrl.options import check_options
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Trajectory

CostToGo = Callable[[Tensor], Tensor]
"""Function from observations ``batch n_o`` to what comes after them ``batch``, in units of L_a."""


@dataclass(frozen=True, kw_only=True)
class PredictiveConfig(RecedingHorizonConfig):
    """Parameters of model predictive control that acts in the place of a policy.

    Args:
        horizon: length of the window over which a plan is made [s]; every plant needs its own.
        forecast: forecast of the exogenous inputs: held for the measured ones, decaying to the mean of the inputs met
            so far with the time that fits them best, or scattered, several futures about the decaying one as its errors
            on these inputs scatter; until inputs have been met, they are held.
        pairs: number of pairs of futures of the scattered forecast.
        terminal: cost of the state at the end of a window: plant for the plant's own where the window ends with the
            episode, or critic for the value that the model-free half has learned of what comes after the window.
        virtual_episodes: number of virtual episodes that it flies in each of the steps 5 and 6, instead of
            virtual_episodes of the algorithm, because each takes as long as all solves of a real episode.

    Raises:
        ValueError: if a number is out of its range.
    """

    horizon: float = 1.0
    forecast: Literal["held", "decaying", "scattered"] = "decaying"
    pairs: int = 4
    terminal: Literal["plant", "critic"] = "plant"
    virtual_episodes: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        check_options(self, infinite=("deadline",))
        for argument in ("pairs", "virtual_episodes"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} of the receding horizon must be at least 1.")


class PredictiveControl(nn.Module):
    """State feedback by :class:`RecedingHorizon`; see :class:`StateFeedback` for the methods.

    Its weights are those of the closure that it plans on, and it has no others; its buffers are those of the forecast.
    Before every episode it plans once from a typical state, which is a draw of the plant, so that the first solve has a
    plan to go on with when it is late. Only :meth:`act` has the deadline: a simulated episode knows no wall clock.

    Args:
        plant: the physics of the model.
        closure: closure of the model, such as that of a twin, which is trained in place.
        config: parameters.

    The attribute ``value`` is the cost-to-go for ``terminal="critic"``, a function of the observation in units of L_a;
    the algorithm sets it to that of its learner.

    Raises:
        ValueError: if :class:`RecedingHorizon` refuses the parameters, or the closure is not on the CPU.
    """

    mean: Tensor
    time: Tensor
    deviations: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, plant: Plant, closure: nn.Module, config: PredictiveConfig):
        super().__init__()
        self.closure, self._plant, self._config = closure, [plant], config  # in a list, it is no submodule
        devices = {str(weight.device) for weight in (*closure.parameters(), *closure.buffers())} - {"cpu"}
        if devices:
            raise ValueError(f"closure is on {', '.join(devices)}; model predictive control needs it on the CPU.")
        n_z = len(plant.inputs)
        # With an infinite time, the inputs are held.
        self.register_buffer("mean", torch.zeros(n_z, dtype=torch.float64))
        self.register_buffer("time", torch.full((n_z,), math.inf, dtype=torch.float64))
        if config.forecast == "scattered":
            deviations = torch.zeros(config.pairs, round(config.horizon / plant.dt), n_z, dtype=torch.float64)
            ends = torch.full((2, n_z), math.inf, dtype=torch.float64)
            self.register_buffer("deviations", deviations)
            self.register_buffer("low", -ends[0])
            self.register_buffer("high", ends[1])
        self.value: CostToGo | None = None
        tail = self._tail if config.terminal == "critic" else None
        timeless = dataclasses.replace(config, deadline=math.inf)
        self._acting, self._virtual = (
            RecedingHorizon(plant, closure, chosen, forecast=self._forecast(), tail=tail)
            for chosen in (config, timeless)
        )
        generator = torch.Generator().manual_seed(0)
        self._typical = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)[:, 0]

    @property
    def terminal(self) -> str:
        """What prices the end of a window."""
        return self._config.terminal

    @property
    def virtual_episodes(self) -> int:
        """Number of virtual episodes that it flies at a time."""
        return self._config.virtual_episodes

    def _forecast(self) -> Forecast:
        """The forecast of the configuration, whose numbers are the buffers."""
        if self._config.forecast == "held":
            return Held()
        decaying = Decaying(self.mean, self.time, dt=self._plant[0].dt)
        if self._config.forecast == "decaying":
            return decaying
        return Scattered(decaying, self.deviations, self.low, self.high)

    def _tail(self, t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
        if self.value is None:
            raise ValueError(
                "terminal='critic' of the receding horizon needs the critic of a learner, which no run folder holds; "
                "set value, or use terminal plant."
            )
        plant = self._plant[0]
        return plant.dt * self.value(plant.observe(t, state, exogenous))

    def learn(self, records: Float[Tensor, "episodes n n_z"]) -> None:
        """Fit the forecast to inputs that have been met, if it is not to hold what is measured.

        Args:
            records: inputs of whole episodes.
        """
        plant = self._plant[0]
        if self._config.forecast == "held" or not plant.inputs:
            return
        longest = min(self._acting.horizon, records.shape[1] - 1) * plant.dt
        fitted = Decaying.fitted(records, dt=plant.dt, horizon=longest)
        self.mean.copy_(fitted.mean)
        self.time.copy_(fitted.time)
        if self._config.forecast == "scattered":
            pairs = self._config.pairs
            scattered = Scattered.fitted(fitted, records, dt=plant.dt, horizon=longest, pairs=pairs)
            self.deviations.copy_(scattered.reaching(self.deviations.shape[1]))
            self.low.copy_(scattered.low)
            self.high.copy_(scattered.high)

    @property
    def solves(self) -> list[Solve]:
        """The solves of the episode in which it acted last, without the one before its beginning."""
        return self._acting.solves

    def begin(self) -> None:
        self._acting.prepare(*self._typical)
        self._acting.solves.clear()

    @torch.no_grad()
    def act(
        self, t: float, state: Float[Tensor, "batch n_s"], exogenous: Float[Tensor, "batch n_z"]
    ) -> Float[Tensor, "batch n_a"]:
        return self._acting.act(t, state, exogenous)

    @torch.no_grad()
    def fly(
        self,
        initial_state: Float[Tensor, "batch n_s"],
        exogenous: Float[Tensor, "batch n n_z"],
        closure: nn.Module | None = None,
        *,
        plant: Plant | None = None,
    ) -> Trajectory:
        self._virtual.prepare(*self._typical)
        flown = self._virtual.fly(initial_state, exogenous, closure, plant=plant)
        self._virtual.solves.clear()
        return flown

    def report(self) -> dict[str, float]:
        """Wall-clock times of the solves [ms], and the numbers of those that were late or diverged."""
        seconds = [solve.seconds for solve in self.solves]
        return {
            "solve_median": 1e3 * statistics.median(seconds),
            "solve_max": 1e3 * max(seconds),
            "late_solves": float(sum(solve.late for solve in self.solves)),
            "diverged_solves": float(sum(solve.diverged for solve in self.solves)),
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
        found = PredictiveControl(self._plant[0], copy.deepcopy(self.closure, memo), self._config)
        found.load_state_dict(self.state_dict())
        found.value = self.value
        memo[id(self)] = found
        return found
