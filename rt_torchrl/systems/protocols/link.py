"""The protocol of a link, over which a client reads and writes the tags of a plant."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable


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
