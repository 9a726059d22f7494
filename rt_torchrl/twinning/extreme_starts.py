"""The extreme initial states of a plant, which a few random draws do not show."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Scenario

SEED = 3_000_000
"""Seed of the initial states among which the extreme ones are found: the same for every training."""
RARE = 0.01
"""Share of all episodes that begin like the extreme ones, by which their cost counts."""


class ExtremeStarts:
    """Episodes that begin with the extremes of each state among many random initial states.

    The weights of a policy that saturates hardly depend on what lies beyond the starts that it was planned on: a plan
    may do the opposite there of what it does everywhere else, and twenty draws do not show it.

    Args:
        plant: the plant, which draws the initial states.
        count: number of random initial states; 0 for no extremes.
        device: device of the states.
    """

    def __init__(self, plant: Plant, count: int, device: torch.device):
        self.states = self._found(plant, count, device)

    @staticmethod
    def _found(plant: Plant, count: int, device: torch.device) -> Float[Tensor, "k n_s"]:
        drawn = plant.draw_initial_state(max(count, 1), torch.Generator(device=device).manual_seed(SEED))
        varied = drawn[:, (drawn != drawn[0]).any(0)]
        return drawn[torch.cat([varied.argmin(0), varied.argmax(0)]).unique()]

    def __bool__(self) -> bool:
        """Whether there are any: initial states that are always the same have no extremes."""
        return bool(len(self.states))

    def under(self, episodes: Scenario) -> Scenario:
        """Episodes with these initial states, under the inputs of some episodes in turn."""
        order = torch.arange(len(self.states), device=self.states.device) % len(episodes.exogenous)
        return Scenario(self.states, episodes.exogenous[order])

    def beside(self, episodes: Scenario) -> Scenario:
        """Some episodes, and those with these initial states."""
        return Scenario(*(torch.cat(pair) for pair in zip(episodes, self.under(episodes), strict=True)))


def astray(tail: float, than: float, *, cost: float, usual: float) -> bool:
    """Whether a policy fails from the extreme starts, where another one does not.

    Its mean cost there is higher by more than the other one's usual cost, and by more than it saves elsewhere where
    one episode in a hundred begins like these. What it costs more everywhere, in the same ratio, does not count.

    Args:
        tail: mean J_a of the policy from the extreme starts.
        than: that of the other policy, from which nothing is asked where it fails itself.
        cost: mean J_a of the policy from random starts.
        usual: that of the other policy.
    """
    if not (math.isfinite(than) and math.isfinite(usual)):
        return False
    saved, ratio = usual - cost, max(1.0, abs(than / usual)) if usual else 1.0
    return tail - than - ratio * max(0.0, -saved) > max(abs(usual), saved / RARE)
