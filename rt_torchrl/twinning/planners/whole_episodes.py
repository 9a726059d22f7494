"""Planning over whole virtual episodes, as in the paper."""

import math
from typing import Any

from torch import Tensor, nn

from rt_torchrl.optimisers.descent import Descended, Descent, stuck
from rt_torchrl.optimisers.limited_mean import limited_mean
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.planners.constraints import Constraints
from rt_torchrl.twinning.planners.planner import PlannerConfig


class WholeEpisodes:
    r"""Descends :math:`J_a = \mathbb E\frac1{T_o}\int L_a\,dt` over the weights of π_mb, on the twin (paper, eq. J_a).

    Args:
        twin: twin with the best closure so far, w_p*.
        policy: policy π_mb, updated in place.
        config: parameters of step 5.

    The attribute ``constraints`` prices what leaves the bounds of ``config.constraints``, in the plans and where the
    algorithm compares policies on the twin. A plan leaves its multipliers as they are.
    """

    def __init__(self, twin: DigitalTwin, policy: nn.Module, config: PlannerConfig):
        self.twin, self.policy, self.config = twin, policy, config
        self.descent = Descent(policy, config.descent)
        self.constraints = Constraints(twin.plant, config.constraints)

    def plan(self, episodes: Scenario) -> Descended:
        """Take n_mb gradients, and as many limited ones where they gain nothing; the policy keeps the best weights."""
        limit = self.config.episode_gradient_limit
        found = self.descent.run(lambda: self._cost(episodes, math.inf), self.config.iterations)
        if self._stalled(found, limit):
            again = self.descent.run(lambda: self._cost(episodes, limit), self.config.iterations)
            found = found._replace(best=again.best, iterations=found.iterations + again.iterations)
        return found

    def _stalled(self, found: Descended, limit: float) -> bool:
        """Whether a descent gained nothing although its first gradient is longer than the limit."""
        weights = [w.detach() for w in self.policy.parameters() if w.requires_grad]
        return stuck(found.start, found.best, found.gradient, weights, limit)

    def _cost(self, episodes: Scenario, limit: float) -> Tensor:
        costs = self.constraints.costs(self.twin, self.policy, episodes)
        return limited_mean(costs, self.policy.parameters(), limit)

    def refuse(self) -> None:
        """Forget the state of the optimiser, because it led to the plan that was refused."""
        self.restart()

    def restart(self) -> None:
        """Forget the state of the optimiser."""
        self.descent.restart()

    def state_dict(self) -> dict[str, Any]:
        priced = {"constraints": self.constraints.state_dict()} if self.constraints else {}
        return self.descent.state_dict() | priced

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if self.constraints:
            self.constraints.load_state_dict(state["constraints"])
        self.descent.load_state_dict({name: part for name, part in state.items() if name != "constraints"})
