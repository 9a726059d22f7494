"""The judgement of new weights: plans, updates and clones stay unless they are worse than what they replace."""

import math
from collections.abc import Callable
from typing import NamedTuple

from torch import nn

from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.twinning.evidence.paired_differences import difference
from rt_torchrl.twinning.evidence.real_judge import RealJudge
from rt_torchrl.twinning.track_record import TrackRecord
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes


class Judgement(NamedTuple):
    """How new weights are judged.

    Args:
        worse: function that says whether the first of two mean J_a is worse than the second one.
        track_record: real episodes, whose last one says whether a twin that diverges is sound.
        evidence: judge of what policies cost on the real system; None judges by the twin alone.
    """

    worse: Callable[[float, float], bool]
    track_record: TrackRecord
    evidence: RealJudge | None = None

    def costs(self, policy: nn.Module, virtual: VirtualEpisodes, episodes: Scenario) -> "Costs":
        """What a policy costs in virtual episodes: on the twin, and on the real system if there is evidence."""
        return self.of(policy, virtual.price(policy, episodes).item())

    def of(self, policy: nn.Module, cost: float) -> "Costs":
        """What a policy costs that has this mean J_a on the twin: on the real system if there is evidence."""
        if self.evidence is None:
            return Costs(cost, cost, cost)
        return Costs(cost, self.evidence.expected(policy, cost), self.evidence.median(policy, cost))


class Costs(NamedTuple):
    """What a policy costs on the twin, and is expected to cost on the real system: in the mean and in the median."""

    twin: float
    expected: float
    median: float

    def withheld(self, stays: "Costs") -> float:
        """How much better the twin alone finds this policy than the one that stays, as log of the costs' ratio.

        It is zero where the twin does not, and where real episodes do not contradict it: a policy that is refused for
        the width of the belief alone may be as good as the twin says.
        """
        if not math.isfinite(self.twin) or self.median < stays.median:
            return 0.0
        return max(0.0, difference(stays.twin, self.twin))
