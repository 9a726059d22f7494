"""A window of operation, as the acting side passes it on to the learner."""

from collections.abc import Mapping
from typing import NamedTuple

from tensordict import TensorDict

from rt_torchrl.systems.safety_report import SafetyReport
from rt_torchrl.systems.sound_part import EpisodeEndedError


class Window(NamedTuple):
    """A window of operation, or the part of it before the system failed.

    Attributes:
        entries: its control intervals, of batch size ``1 k``; None if there are none.
        ended: why the system did not reach the end of the window; None if it did.
        report: what the safety layer did in it; None if there is no layer.
        acted: numbers about what acted at its end, such as the times of the solves of model predictive control.
    """

    entries: TensorDict | None
    ended: str | None = None
    report: SafetyReport | None = None
    acted: Mapping[str, float] | None = None

    def segments(self, first: int) -> list[tuple[int, int]]:
        """The versions that acted, each with the interval in which it began to.

        Args:
            first: number of the window's first interval since the operation began.
        """
        if self.entries is None:
            return []
        versions = self.entries["version"].flatten().tolist()
        starts = [k for k in range(len(versions)) if k == 0 or versions[k] != versions[k - 1]]
        return [(first + k, versions[k]) for k in starts]

    def whole(self) -> TensorDict:
        """The control intervals of a whole window.

        Raises:
            EpisodeEndedError: if the system failed in it, or ended it; it holds the intervals before.
        """
        if self.ended is not None or self.entries is None:
            raise EpisodeEndedError(self.ended or "the window holds no interval", self.entries)
        return self.entries
