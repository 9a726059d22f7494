"""Costs of the latest real episodes, as measured and as the twin predicts them."""

import copy
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

from torch import Tensor, nn

from rt_torchrl.trajectories.trajectory import Scenario, Trajectory
from rt_torchrl.twinning.referees import Role
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes

COMPARED = 2
"""Number of episodes that are kept; a change of the cost takes two."""


class Flown(NamedTuple):
    """A real episode: its trajectory, the role and the weights of the policy that flew it, and its J_a."""

    trajectory: Trajectory
    role: Role
    weights: dict[str, Tensor]
    cost: float


class TrackRecord:
    """The latest real episodes, oldest first, with the weights that flew them.

    Args:
        policies: both policies, by role; a copy of the one that flew an episode takes the weights of that episode.
    """

    def __init__(self, policies: Mapping[Role, nn.Module]):
        self._policies = policies
        self._flown: deque[Flown] = deque(maxlen=COMPARED)

    def append(self, trajectory: Trajectory, role: Role, cost: float) -> None:
        """Add an episode that the policy with this role has just flown."""
        weights = {name: weight.detach().clone() for name, weight in self._policies[role].state_dict().items()}
        self._flown.append(Flown(trajectory, role, weights, cost))

    @property
    def real_costs(self) -> tuple[float, ...]:
        """J_a of the episodes, as measured."""
        return tuple(flown.cost for flown in self._flown)

    def predicted_costs(self, virtual: VirtualEpisodes) -> tuple[float, ...]:
        """J_a of the same episodes on the twin, flown with the same weights from the same state under the same inputs.

        It is infinite for an episode in which the twin diverges.
        """
        starts = (Scenario(flown.trajectory.states[:1], flown.trajectory.exogenous[None]) for flown in self._flown)
        pairs = zip(self._flown, starts, strict=True)
        return tuple(virtual.cost(self._policy(flown), start).item() for flown, start in pairs)

    def policy_flown(self) -> nn.Module:
        """The policy that has flown the latest episode, with the weights that it had in it."""
        return self._policy(self._flown[-1])

    def _policy(self, flown: Flown) -> nn.Module:
        policy = copy.deepcopy(self._policies[flown.role])
        policy.load_state_dict(flown.weights)
        return policy

    def state_dict(self) -> dict[str, Any]:
        return {"flown": [flown._asdict() | {"trajectory": flown.trajectory._asdict()} for flown in self._flown]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._flown.clear()
        self._flown.extend(
            Flown(**flown | {"trajectory": Trajectory(**flown["trajectory"])}) for flown in state["flown"]
        )
