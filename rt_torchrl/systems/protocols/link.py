"""The protocol of a link, over which a client reads and writes the tags of a plant."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from rt_torchrl.options import require_range

LONGEST = 60.0
"""Longest time of an answer for which any control loop waits [s]."""


class LinkLostError(OSError):
    """The plant does not answer: the connection is lost, or an answer did not come in time."""


class LateAnswerError(LinkLostError):
    """An answer did not come in time; the connection may still be there."""


@runtime_checkable
class Link(Protocol):
    """A connection to a plant's control system. A tag is a named number there.

    All methods but ``connect`` answer within a fraction of the control period, or raise.
    """

    def connect(self) -> None:
        """Connect, or connect again.

        Raises:
            LinkLostError: if the plant does not answer.
        """

    def read(self) -> dict[str, float]:
        """All tags that are read, by name, in one request.

        Raises:
            LinkLostError: if the plant does not answer in time.
        """

    def write(self, values: Mapping[str, float]) -> None:
        """Write tags, in one request.

        Raises:
            LinkLostError: if the plant does not answer in time.
        """

    def close(self) -> None:
        """Close the connection, if there is one."""


def require_timeout(timeout: float) -> None:
    """Refuse a longest time of an answer [s] that is not positive, or for which no control loop waits.

    Raises:
        ValueError: if it is one of these.
    """
    if not timeout > 0.0:
        raise ValueError(f"timeout={timeout} s of the link must be positive.")
    require_range("timeout", timeout, 0.0, LONGEST, unit="s", of="the link")
