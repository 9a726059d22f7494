"""Costs of the latest real episodes, as measured and as the twin predicts them."""

import copy
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory
from rt_torchrl.twinning.evidence.paired_differences import PairedDifferences, difference
from rt_torchrl.twinning.referees import Role
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes

COMPARED = 2
"""Number of episodes by which a change of the cost is judged."""
KEPT = 10
"""Number of episodes that are kept."""
LOOKED_AT = 64
"""Number of observations in which policies are compared."""
ELSEWHERE = 10.0
"""Action that stands for all of state feedback, which is no function of an observation and no neighbour of a policy."""


class Flown(NamedTuple):
    """A real episode: its trajectory, the role and weights of the policy that flew it, its J_a and its exploration."""

    trajectory: Trajectory
    role: Role
    weights: dict[str, Tensor]
    cost: float
    exploration: float = 0.0


class TrackRecord:
    """The latest real episodes, oldest first, with the weights that flew them.

    Args:
        policies: both policies, by role; a copy of the one that flew an episode takes the weights of that episode.
    """

    def __init__(self, policies: Mapping[Role, nn.Module]):
        self._policies = policies
        self._flown: deque[Flown] = deque(maxlen=KEPT)

    def append(
        self,
        trajectory: Trajectory,
        role: Role,
        cost: float,
        exploration: float = 0.0,
        weights: Mapping[str, Tensor] | None = None,
    ) -> None:
        """Add an episode that the policy with this role has just flown, with its present weights or with others."""
        weights = self._policies[role].state_dict() if weights is None else weights
        weights = {name: weight.detach().clone() for name, weight in weights.items()}
        self._flown.append(Flown(trajectory, role, weights, cost, exploration))

    @property
    def real_costs(self) -> tuple[float, ...]:
        """J_a of the last two episodes, as measured."""
        return tuple(flown.cost for flown in self._latest())

    def predicted_costs(self, virtual: VirtualEpisodes) -> tuple[float, ...]:
        """J_a of the same episodes on the twin, flown with the same weights from the same state under the same inputs.

        It is infinite for an episode in which the twin diverges.
        """
        return tuple(self._predicted(flown, virtual) for flown in self._latest())

    def differences(self, virtual: VirtualEpisodes) -> "Differences":
        """The paired differences of all episodes that are kept, but not of state feedback, whose flights are long."""
        flown = [one for one in self._flown if not isinstance(self._policies[one.role], StateFeedback)]
        pairs = [difference(one.cost, self._predicted(one, virtual)) for one in flown]
        return Differences([self._policy(one) for one in flown], pairs, [one.exploration for one in flown], flown)

    def _latest(self) -> list[Flown]:
        return list(self._flown)[-COMPARED:]

    def _predicted(self, flown: Flown, virtual: VirtualEpisodes) -> float:
        return virtual.cost(self._policy(flown), virtual.repeated(flown.trajectory)).item()

    @property
    def latest_record(self) -> Trajectory:
        """The latest real episode."""
        return self._flown[-1].trajectory

    def policy_flown(self) -> nn.Module:
        """The policy that has flown the latest episode, with the weights that it had in it."""
        return self._policy(self._flown[-1])

    def require_sound_twin(self, virtual: VirtualEpisodes, episodes: Scenario) -> None:
        """Refuse a closure under which the twin diverges with the weights that have just flown on the real system.

        Raises:
            DivergenceError: if it does.
        """
        if not virtual.cost(self.policy_flown(), episodes).isfinite():
            twin = virtual.twin
            raise DivergenceError(
                f"plant {twin.plant.name!r} diverged on its twin with the weights that have just flown on the real "
                f"system; the closure is {type(twin.closure).__name__}."
            )

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


class Differences(NamedTuple):
    """Paired differences of real episodes, oldest first, with the policies that flew them, and the episodes."""

    policies: list[nn.Module]
    values: list[float]
    exploration: list[float]
    flown: Sequence[Flown] = ()

    def learned(self, plant: Plant, record: Trajectory) -> PairedDifferences:
        """The belief about all policies, which are compared in the observations of a record."""
        actions = [shares(policy, plant, record) for policy in self.policies]
        stacked = torch.stack(actions) if actions else record.states.new_empty(0, 1)
        return PairedDifferences(stacked, stacked.new_tensor(self.values), stacked.new_tensor(self.exploration))


def shares(policy: nn.Module, plant: Plant, record: Trajectory) -> Float[Tensor, " m"]:
    """A policy's actions in some observations of a record, in shares of half their ranges, in one vector."""
    n = len(record.actions)
    at = torch.linspace(0, n - 1, min(n, LOOKED_AT), device=record.states.device).round().long()
    if isinstance(policy, StateFeedback):
        return torch.full((len(at) * len(plant.actions),), ELSEWHERE, dtype=torch.float64, device=at.device)
    observations = plant.observe(record.start + at.double() * plant.dt, record.states[at], record.exogenous[at])
    low, high = bounds(plant.actions, device=at.device)
    return (2.0 * policy(observations) / (high - low)).flatten()
