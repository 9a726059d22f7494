"""The examination of the twin by the real episodes: paired differences, beliefs about policies, and the alarm."""

from collections.abc import Mapping

import torch
from tensordict import TensorDict
from torch import nn

from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.twinning.evidence.alarm import QUIET, alarm
from rt_torchrl.twinning.evidence.paired_differences import Belief, PairedDifferences
from rt_torchrl.twinning.findings import findings
from rt_torchrl.twinning.referees import Role
from rt_torchrl.twinning.track_record import TrackRecord, shares
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes


class Examination:
    """Compares what real episodes cost with what the twin says of them.

    Args:
        track_record: the real episodes.
        virtual: virtual episodes of the twin.
    """

    def __init__(self, track_record: TrackRecord, virtual: VirtualEpisodes):
        self.track_record, self.virtual = track_record, virtual

    @torch.no_grad()
    def examine(self) -> TensorDict:
        """Fly the latest real episodes on the present twin.

        Returns:
            ``paired_difference`` of the last episode, and ``alarm``, with a ``warning`` in words if it is 1; nothing if
            state feedback flew them.
        """
        found = self.track_record.differences(self.virtual)
        if not found.values:
            return findings()
        quiet = [d for d, noise in zip(found.values, found.exploration, strict=True) if noise <= QUIET]
        said = alarm(quiet)
        explained = self.virtual.twin.explanation()
        report = findings(paired_difference=found.values[-1], alarm=float(said is not None))
        return report if said is None else report.set_non_tensor("warning", f"{said}; {explained}".rstrip("; "))

    @torch.no_grad()
    def beliefs(self, policies: Mapping[Role, nn.Module], record: Trajectory) -> dict[Role, Belief]:
        """The belief about log J_real − log J_twin of each policy, compared in the observations of a record."""
        plant = self.virtual.twin.plant
        learned: PairedDifferences = self.track_record.differences(self.virtual).learned(plant, record)
        return {role: learned.belief(shares(policy, plant, record)) for role, policy in policies.items()}
