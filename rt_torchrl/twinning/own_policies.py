"""The policies that learner and planner train are those of the algorithm."""

from collections.abc import Mapping

from torch import nn

from rt_torchrl.steps.learn import Learner
from rt_torchrl.twinning.planners import Planner
from rt_torchrl.twinning.referees import Role


def require_own_policies(policies: Mapping[Role, nn.Module], trained: Mapping[Role, Learner | Planner]) -> None:
    """Refuse a learner or planner that trains another policy than that of its role.

    Raises:
        ValueError: if there is one; it names the role.
    """
    for role, part in trained.items():
        if part.policy is not policies[role]:
            raise ValueError(f"{type(part).__name__} trains another policy than {role}; build it with that module.")
