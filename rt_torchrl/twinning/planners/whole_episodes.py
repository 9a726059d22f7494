"""Planning over whole virtual episodes, as in the paper."""

from typing import Any

from torch import nn

from rt_torchrl.optimisers.descent import Descended, Descent
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.planners.planner import PlannerConfig


class WholeEpisodes:
    r"""Descends :math:`J_a = \mathbb E\frac1{T_o}\int L_a\,dt` over the weights of π_mb, on the twin (paper, eq. J_a).

    Args:
        twin: twin with the best closure so far, w_p*.
        policy: policy π_mb, updated in place.
        config: parameters of step 5.
    """

    def __init__(self, twin: DigitalTwin, policy: nn.Module, config: PlannerConfig):
        self.twin, self.policy, self.config = twin, policy, config
        self.descent = Descent(policy, config.descent)
        self.plans = 0

    def plan(self, episodes: Scenario) -> Descended:
        """Take n_mb gradient steps, later more of them; the policy keeps the best weights seen in them."""
        self.plans += 1
        iterations = self.config.iterations * min(self.plans, self.config.growth)
        return self.descent.run(lambda: self.twin.cost(self.policy, *episodes), iterations)

    def refuse(self) -> None:
        """Forget the state of the optimiser, because it led to the plan that was refused."""
        self.restart()

    def restart(self) -> None:
        """Forget the state of the optimiser."""
        self.descent.restart()

    def state_dict(self) -> dict[str, Any]:
        return {"descent": self.descent.state_dict(), "plans": self.plans}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.descent.load_state_dict(state["descent"])
        self.plans = state["plans"]
