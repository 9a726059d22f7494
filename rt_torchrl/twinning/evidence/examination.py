"""The examination of the twin by the real episodes: paired differences, beliefs about policies, and the alarm."""

from collections.abc import Sequence

import torch
from tensordict import TensorDict

from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of, control_cost
from rt_torchrl.twinning.assimilation import Assimilation
from rt_torchrl.twinning.evidence.alarm import MATTERS, QUIET, alarm, contradiction
from rt_torchrl.twinning.evidence.paired_differences import LARGEST, difference, unexplained
from rt_torchrl.twinning.evidence.real_judge import RealJudge
from rt_torchrl.twinning.findings import findings, merged
from rt_torchrl.twinning.track_record import TrackRecord
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes


class Examination:
    """Compares what real episodes cost with what the twin says of them.

    The attribute ``unexplained`` is the size of the paired difference of the latest episode or, where it explored by
    more than ``QUIET``, beyond two standard deviations of what exploration explains.

    Args:
        track_record: the real episodes.
        virtual: virtual episodes of the twin.
    """

    def __init__(self, track_record: TrackRecord, virtual: VirtualEpisodes):
        self.track_record, self.virtual = track_record, virtual
        self.unexplained, self._said = 0.0, False

    @torch.no_grad()
    def examine(self) -> TensorDict:
        """Fly the latest real episodes on the present twin.

        Returns:
            ``paired_difference`` of the last episode, and ``alarm``, with a ``warning`` in words if it is 1. Nothing if
            state feedback flew them.
        """
        found = self.track_record.differences(self.virtual)
        self.track_record.weigh(found)
        if len(found.values) == found.earlier:
            self.unexplained, self._said = 0.0, False
            return findings()
        now, explored = found.values[-1], found.exploration[-1]
        self.unexplained = abs(now) if explored <= QUIET else unexplained(now, explored)
        latest = list(zip(found.values, found.exploration, strict=True))[found.earlier :]
        said = alarm([d for d, explored in latest if explored <= QUIET])
        self._said = said is not None
        explained = self.virtual.twin.explanation()
        report = findings(paired_difference=now, alarm=float(said is not None))
        return report if said is None else report.set_non_tensor("warning", f"{said}; {explained}".rstrip("; "))

    def explained(self, assimilation: Assimilation, generator: torch.Generator) -> TensorDict:
        """As :meth:`examine`, once step 4 has sought what explains the difference."""
        found = self.examine()
        if not assimilation.explain(self.unexplained, generator):
            return found
        return merged(findings(**assimilation.report()), self.examine())

    def told(self, plan: TensorDict) -> TensorDict:
        """The report of a plan, with the alarm where real episodes contradict what the twin would plan.

        Args:
            plan: report of step 5, in which ``withheld`` is the log of the ratio of costs on the twin by which it
                prefers what was refused to the policy that stays.
        """
        withheld = float(plan.get("withheld", 0.0))
        if withheld <= MATTERS or self._said:
            return plan
        said = f"{contradiction(withheld)}; {self.virtual.twin.explanation()}".rstrip("; ")
        return plan.update(findings(alarm=1.0)).set_non_tensor("warning", said)

    @torch.no_grad()
    def replayed(self, records: Sequence[Trajectory]) -> float:
        """Greatest size of the paired differences of records whose actions the twin replays.

        It takes the place of ``examine`` where no policy can fly them again.
        """
        whole, twin = batch_of(records), self.virtual.twin
        try:
            flown = twin.replay(whole.states[:, 0], whole.exogenous, whole.actions, start=whole.start)
        except DivergenceError:
            return LARGEST
        real, predicted = (control_cost(twin.plant, one).tolist() for one in (whole, flown))
        return max(abs(difference(*pair)) for pair in zip(real, predicted, strict=True))

    def judge(self, record: Trajectory) -> RealJudge:
        """The judge of policies by the evidence so far; a record gives the observations in which they are compared."""
        found = self.track_record.differences(self.virtual)
        return RealJudge(found, found.learned(self.virtual.twin.plant, record), self.virtual, record)

    def correction(self, record: Trajectory) -> RealJudge | None:
        """The judge of plans, where one of the latest real episodes contradicts the twin beyond chance; else None.

        A twin that has been right so far keeps the last word: the belief about a policy that never flew is so wide that
        it would refuse plans which are as good as the twin says.
        """
        judge = self.judge(record)
        return judge if judge.contradicts else None
