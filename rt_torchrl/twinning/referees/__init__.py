"""Referees for step 6."""

from rt_torchrl.twinning.referees.decision_tree import DecisionTree
from rt_torchrl.twinning.referees.referee import ROLES, Event, Evidence, Referee, RefereeConfig, RefereeName, Role
from rt_torchrl.twinning.referees.weight_of_evidence import WeightOfEvidence

REFEREES: dict[RefereeName, type[DecisionTree] | type[WeightOfEvidence]] = {
    "decision_tree": DecisionTree,
    "weight_of_evidence": WeightOfEvidence,
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
    "WeightOfEvidence",
    "make_referee",
]
