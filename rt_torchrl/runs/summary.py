"""What the ``summary`` of a run says of its policies."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rt_torchrl.twinning.referees import Role


def preferred_role(summary: Mapping[str, Any]) -> "Role":
    """The role that the referee prefers at the end; in the summary of an earlier version the live one."""
    role: Role = summary.get("preferred", summary["live"])
    return role
