"""Referees for step 6."""

from rt_torchrl.twinning.referees.decision_tree import DecisionTree
from rt_torchrl.twinning.referees.referee import ROLES, Event, Evidence, Referee, RefereeConfig, RefereeName, Role
from rt_torchrl.twinning.referees.trust_ratio import TrustRatio

REFEREES: dict[RefereeName, type[DecisionTree] | type[TrustRatio]] = {
    "decision_tree": DecisionTree,
    "trust_ratio": TrustRatio,
}


def make_referee(config: RefereeConfig, live: Role) -> Referee:
    """The referee that a configuration names; the role ``live`` starts live."""
    return REFEREES[config.rule](config, live)


__all__ = [
    "ROLES",
    "DecisionTree",
    "Event",
    "Evidence",
    "Referee",
    "RefereeConfig",
    "Role",
    "TrustRatio",
    "make_referee",
]
