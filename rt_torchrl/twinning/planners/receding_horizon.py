"""Model predictive control in step 5: nothing descends, because it plans while it acts."""

from typing import Any

from torch import nn

from rt_torchrl.control.predictive_control import PredictiveControl
from rt_torchrl.optimisers.descent import Descended
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.planners.planner import PlannerConfig


class RecedingHorizonPlanner:
    """Fits the forecast of model predictive control to the inputs that have been met.

    The controller plans on the twin's closure itself, and so follows step 4 at once.

    Args:
        twin: twin on which the controller plans.
        policy: the controller, which acts in the place of π_mb.
        config: parameters of step 5.

    Raises:
        ValueError: if the controller plans on another closure than the twin's.
    """

    policy: nn.Module

    def __init__(self, twin: DigitalTwin, policy: PredictiveControl, config: PlannerConfig):
        if policy.closure is not twin.closure:
            raise ValueError("the controller plans on another closure than the twin's; build it with twin.closure.")
        self.twin, self.policy, self.config, self._learn = twin, policy, config, policy.learn

    def plan(self, episodes: Scenario) -> Descended:
        """Fit the forecast to the inputs of the episodes; the cost before is the cost after, without a gradient."""
        self._learn(episodes.exogenous)
        count = self.config.receding_horizon.virtual_episodes
        cost = self.twin.cost(self.policy, episodes.initial_state[:count], episodes.exogenous[:count]).item()
        return Descended(cost, cost, 0.0, 0)

    def refuse(self) -> None:
        """Do nothing: there are no weights to go back to."""

    def restart(self) -> None:
        """Do nothing: the closure has jumped back, and the controller plans on it as it is."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing: the forecast belongs to the controller."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Do nothing."""
