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


class RefusedRequestError(ValueError):
    """The plant answers, and refuses: a tag is unknown, may not be written, or does not take the value.

    Another attempt would be refused as well; tags, types or rights must be mended.
    """


@runtime_checkable
class Link(Protocol):
    """A connection to a plant's control system. A tag is a named number there.

    All methods but ``connect`` answer within a fraction of the control period, or raise. A tag that the control system
    marks as not good is NaN; a link may say why in an attribute ``quality``, a text for each tag of the last reading
    that is not good.
    """

    def connect(self) -> None:
        """Connect, or connect again.

        Raises:
            LinkLostError: if the plant does not answer.
            RefusedRequestError: if a tag is unknown there, or cannot take a number.
        """

    def read(self) -> dict[str, float]:
        """All tags that are read, by name, in one request.

        Raises:
            LinkLostError: if the plant does not answer in time.
            RefusedRequestError: if it refuses.
        """

    def write(self, values: Mapping[str, float]) -> None:
        """Write tags, in one request.

        Raises:
            LinkLostError: if the plant does not answer in time.
            RefusedRequestError: if it refuses a value.
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
