"""What policies are expected to cost on the real system, by the paired differences of real episodes."""

import copy
import math
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.trajectories.trajectory import Scenario, Trajectory
from rt_torchrl.twinning.architecture import same_architecture
from rt_torchrl.twinning.evidence.alarm import BEYOND_CHANCE
from rt_torchrl.twinning.evidence.paired_differences import (
    Belief,
    PairedDifferences,
    difference,
    excess,
    unexplained,
)
from rt_torchrl.twinning.track_record import Differences, shares
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes

RECALLED_BELOW = 0.98
"""Share of the present policy's expected cost below which earlier weights take its place."""


class RealJudge:
    r"""Judges policies by what they are expected to cost on the real system, :math:`\hat J e^{m + s^2/2}`.

    Args:
        differences: paired differences of real episodes.
        learned: the belief about all policies that follows from them.
        virtual: virtual episodes, which give Ĵ.
        record: record in whose observations policies are compared.
    """

    def __init__(
        self, differences: Differences, learned: PairedDifferences, virtual: VirtualEpisodes, record: Trajectory
    ):
        self.differences, self.learned, self.virtual, self.record = differences, learned, virtual, record

    def shares(self, policy: nn.Module) -> Float[Tensor, " m"]:
        """Actions in which policies are compared, in shares of half their ranges."""
        return shares(policy, self.virtual.twin.plant, self.record)

    @property
    def contradicts(self) -> bool:
        """Whether one of the real episodes contradicts the twin beyond chance."""
        sizes = map(unexplained, self.differences.values, self.differences.exploration)
        return max(sizes, default=0.0) > BEYOND_CHANCE

    @torch.no_grad()
    def belief(self, policy: nn.Module, cost: float) -> Belief:
        """The belief about log J_real − log J_twin of a policy, where it has this cost on the twin."""
        return self.learned.of(self.differences.about(cost)).belief(self.shares(policy))

    @torch.no_grad()
    def difference(self, one: tuple[nn.Module, float], other: tuple[nn.Module, float]) -> Belief:
        """The joint belief about d of one policy less d of another; each comes with its cost on the twin."""
        mean = self.belief(*one).mean - self.belief(*other).mean
        return Belief(mean, self.learned.deviation_between(self.shares(one[0]), self.shares(other[0])))

    def expected(self, policy: nn.Module, cost: float) -> float:
        """The cost that is expected of a policy on the real system, where it has this cost on the twin."""
        return expected_cost(cost, self.belief(policy, cost))

    def median(self, policy: nn.Module, cost: float) -> float:
        """The cost on the real system that is as likely exceeded as not."""
        return cost * math.exp(self.belief(policy, cost).mean) if cost > 0.0 else cost

    @cached_property
    def _cautious(self) -> PairedDifferences:
        """The belief that follows from paired differences of at least zero."""
        return self.learned.at_least(0.0)

    @torch.no_grad()
    def cautious(self, policy: nn.Module, cost: float) -> float:
        """The cost that is expected on the real system where no flight counts as cheaper than the twin says."""
        return expected_cost(cost, self._cautious.belief(self.shares(policy)))

    @torch.no_grad()
    def refuted(self, policy: nn.Module) -> float:
        """How much better the twin finds weights that have flown than a policy, where their flights refute it.

        Each is compared in the episode that it flew, because in one of many random episodes the twin may blow up. An
        episode refutes the twin if it cost more than the twin says even now, beyond chance, and more than the policy is
        expected to cost in it.

        Returns:
            The greatest log of the ratio of both costs on the twin; zero if the twin prefers nothing that is refuted.
        """
        found, sizes = self.differences, [0.0]
        for one, d, explored, flown in zip(found.policies, found.values, found.exploration, found.flown, strict=True):
            if not excess(d, explored) > 0.0 or not same_architecture(one, policy):
                continue
            episode = self.virtual.repeated(flown.trajectory)
            predicted, stays = (self.virtual.cost(each, episode).item() for each in (one, policy))
            if math.isfinite(predicted) and self.median(policy, stays) < flown.cost:
                sizes.append(difference(stays, predicted))
        return max(sizes)

    @torch.no_grad()
    def recalled(self, policy: nn.Module, episodes: Scenario) -> dict[str, Tensor] | None:
        """Weights that have flown, and are expected to cost less than the present ones; None if there are none.

        That flights with other weights cost less than the twin says does not count for them: it differs from gust to
        gust more than from policy to policy, and is no reason to leave a policy.
        """
        flown = [one for one in self.differences.policies if same_architecture(one, policy)]
        costs = [self.cautious(one, self.virtual.price(one, episodes).item()) for one in flown]
        present = self.expected(policy, self.virtual.price(policy, episodes).item())
        if not costs or not min(costs) < RECALLED_BELOW * present:
            return None
        return copy.deepcopy(flown[costs.index(min(costs))].state_dict())


def expected_cost(cost: float, belief: Belief) -> float:
    """The mean cost on the real system, where it has this cost on the twin."""
    return cost * math.exp(belief.mean + 0.5 * belief.deviation**2) if cost > 0.0 else cost
