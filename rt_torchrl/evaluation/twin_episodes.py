"""Unseen episodes on the twin, for a real system that is not a simulation of this library."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of, control_cost
from rt_torchrl.trajectories.twin import DigitalTwin


class TwinEpisodes(UnseenEpisodes):
    """Episodes that are flown on the twin as it is now: the one that is most likely to be right.

    The real system does not move. Costs here are what the twin says, not what the real system would cost. Initial
    states and disturbances are the plant's draws. An episode in which the twin diverges costs NaN, and so do its mean
    and its confidence interval.

    Args:
        twin: the twin.
        plant: physics and control problem of the real system.
        count: number of episodes, at least 2.
        device: device of the twin.
    """

    judged_on = "twin"

    def __init__(self, twin: DigitalTwin, plant: Plant, count: int = 20, *, device: torch.device | str = "cpu"):
        super().__init__(plant, count, device=device)
        self.closure, self._twin = None, twin

    @property
    def flying(self) -> Plant:
        """The plant of the believed twin, which has more states than the real system's where a hypothesis adds some."""
        return self._twin.believed.plant

    @torch.no_grad()
    def fly(self, policy: nn.Module) -> Trajectory:
        """Fly the episodes with a policy on the twin."""
        count = len(self.initial_state)
        try:
            return self._flown(policy, slice(0, count))
        except DivergenceError:
            return batch_of([self._alone(policy, k) for k in range(count)])

    def _flown(self, policy: nn.Module, some: slice) -> Trajectory:
        believed = self._twin.believed
        return believed.control(policy, believed.plant.at_rest(self.initial_state[some]), self.exogenous[some])

    def _alone(self, policy: nn.Module, k: int) -> Trajectory:
        """One episode; not a number from its first interval on where the twin diverges in it."""
        try:
            return self._flown(policy, slice(k, k + 1)).each()[0]
        except DivergenceError:
            start, exogenous = self.flying.at_rest(self.initial_state[k]), self.exogenous[k]
            lost = start.new_full((len(exogenous), len(start)), torch.nan)
            actions = start.new_full((len(exogenous), len(self.plant.actions)), torch.nan)
            return Trajectory(torch.cat([start[None], lost]), actions, exogenous)

    @torch.no_grad()
    def control_costs(self, policy: nn.Module) -> Float[Tensor, " count"]:
        return control_cost(self.flying, self.fly(policy))

    def validation(self) -> None:
        """No validation episodes, because the referee has compared the policies on the twin already."""

    def identification_costs(self, physics: Plant, closure: nn.Module, flown: Trajectory) -> Float[Tensor, " count"]:
        """Not a number: the real system has not flown these episodes, so that no twin can be compared with it."""
        return torch.full((len(flown.states),), torch.nan, dtype=torch.float64, device=flown.states.device)
