"""Costs of real episodes, as measured and as the twin predicts them: the latest, and earlier ones that refute it."""

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils._pytree import tree_flatten

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory
from rt_torchrl.twinning.evidence.paired_differences import LEAST, PairedDifferences, difference, excess
from rt_torchrl.twinning.referees import Role
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes

COMPARED = 2
"""Number of episodes by which a change of the cost is judged."""
LATEST = 10
"""Number of latest episodes that are kept."""
REFUTING = 10
"""Number of earlier episodes that are kept beside them, because they contradict the twin."""
LOOKED_AT = 64
"""Number of observations in which policies are compared."""
ELSEWHERE = 10.0
"""Action that stands for all of state feedback, which is no function of an observation and no neighbour of a policy."""


class Flown(NamedTuple):
    """A real episode: its trajectory, the role and weights of the policy that flew it, its J_a and its exploration.

    ``excess`` is that of its paired difference beyond chance, by the twin that was examined last; see :func:`excess`.
    """

    trajectory: Trajectory
    role: Role
    weights: dict[str, Tensor]
    cost: float
    exploration: float = 0.0
    excess: float = 0.0

    def repeats(self, other: "Flown") -> bool:
        """Whether the same policy flew the other episode with the same weights."""
        same = self.role == other.role
        return same and all(torch.equal(weight, other.weights[name]) for name, weight in self.weights.items())


class TrackRecord:
    """The latest real episodes, with the weights that flew them, and before these some that contradict the twin.

    The twin would plan again what only episodes of long ago refute. One that leaves the latest ones therefore stays if
    it contradicts the twin, once for the same weights; of more than ``REFUTING``, those stay that contradict it most.
    Episodes are in the order in which they were flown.

    Args:
        policies: both policies, by role; a copy of the one that flew an episode takes the weights of that episode.
    """

    def __init__(self, policies: Mapping[Role, nn.Module]):
        self._policies = policies
        self._flown: list[Flown] = []
        self._found: tuple[Any, Differences] | None = None

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
        self._flown, self._found = [*self._refuting(), *self._flown[-LATEST:]], None

    def _refuting(self) -> list[Flown]:
        """The episodes before the latest ones that stay, of which the last one has just left these."""
        stay: list[Flown] = []
        for one in sorted(self._flown[:-LATEST], key=lambda each: -each.excess):
            if one.excess > 0.0 and len(stay) < REFUTING and not any(one.repeats(other) for other in stay):
                stay.append(one)
        return [one for one in self._flown[:-LATEST] if any(one is other for other in stay)]

    def weigh(self, found: "Differences") -> None:
        """Take how much dearer than the present twin says the episodes of these differences were."""
        flights = [id(one.trajectory) for one in found.flown]
        sizes = dict(zip(flights, map(excess, found.values, found.exploration), strict=True))
        self._flown = [one._replace(excess=sizes.get(id(one.trajectory), 0.0)) for one in self._flown]

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
        """The paired differences of all episodes that are kept, but not of state feedback, whose flights are long.

        The episodes are flown again only where the twin has changed.

        Raises:
            ValueError: if the cost of one is negative, because differences are logs of the ratio of two costs.
        """
        state = virtual.twin.state_dict()
        if self._found is None or not equal(state, self._found[0]):
            self._found = copy.deepcopy(state), self._differences(virtual)
        return self._found[1]

    def _differences(self, virtual: VirtualEpisodes) -> "Differences":
        earlier, latest = (
            [one for one in part if not isinstance(self._policies[one.role], StateFeedback)]
            for part in (self._flown[:-LATEST], self._flown[-LATEST:])
        )
        flown = [*earlier, *latest]
        negative = next((one.cost for one in flown if one.cost < 0.0), None)
        if negative is not None:
            raise ValueError(
                f"J_a={negative:.4g} of a real episode of plant {virtual.twin.plant.name!r} is negative; a training "
                "with a twin compares costs by their ratio. Let running_cost and terminal_cost of the plant add a "
                "constant that keeps them positive, or penalise squares of errors; arm='model_free' takes any cost."
            )
        pairs = [difference(one.cost, self._predicted(one, virtual)) for one in flown]
        explored = [one.exploration for one in flown]
        return Differences([self._policy(one) for one in flown], pairs, explored, flown, len(earlier))

    def _latest(self) -> list[Flown]:
        return self._flown[-COMPARED:]

    def _predicted(self, flown: Flown, virtual: VirtualEpisodes) -> float:
        return virtual.cost(self._policy(flown), virtual.repeated(flown.trajectory)).item()

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
        self._flown = [Flown(**flown | {"trajectory": Trajectory(**flown["trajectory"])}) for flown in state["flown"]]
        self._found = None


class Differences(NamedTuple):
    """Paired differences of real episodes, oldest first, with the policies that flew them, and the episodes.

    The first ``earlier`` of them are not among the latest episodes.
    """

    policies: list[nn.Module]
    values: list[float]
    exploration: list[float]
    flown: Sequence[Flown]
    earlier: int = 0

    def about(self, cost: float) -> list[float]:
        """The paired differences, as far as they tell of a policy that has this mean J_a on the twin.

        A twin that says more than e times the real cost blows up or stalls where the real system does not, and need not
        do so with the neighbours of a policy. Such an episode says that a neighbour costs no more than it did, and
        nothing of one that costs less even on the twin.
        """
        if not 0.0 < cost < math.inf:
            return self.values
        pairs = zip(self.values, self.flown, strict=True)
        return [
            d if d >= LEAST or not one.cost > 0.0 else max(d, min(0.0, math.log(one.cost / cost))) for d, one in pairs
        ]

    def learned(self, plant: Plant, record: Trajectory) -> PairedDifferences:
        """The belief about all policies, which are compared in the observations of a record."""
        actions = [shares(policy, plant, record) for policy in self.policies]
        stacked = torch.stack(actions) if actions else record.states.new_empty(0, 1)
        return PairedDifferences(stacked, stacked.new_tensor(self.values), stacked.new_tensor(self.exploration))


def equal(state: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two states of a twin are the same."""
    (one, structure), (two, its_structure) = tree_flatten(state), tree_flatten(other)
    return structure == its_structure and all(
        torch.equal(a, b) if isinstance(a, Tensor) else a == b for a, b in zip(one, two, strict=True)
    )


def shares(policy: nn.Module, plant: Plant, record: Trajectory) -> Float[Tensor, " m"]:
    """A policy's actions in some observations of a record, in shares of half their ranges, in one vector."""
    n = len(record.actions)
    at = torch.linspace(0, n - 1, min(n, LOOKED_AT), device=record.states.device).round().long()
    if isinstance(policy, StateFeedback):
        return torch.full((len(at) * len(plant.actions),), ELSEWHERE, dtype=torch.float64, device=at.device)
    observations = plant.observe(record.start + at.double() * plant.dt, record.states[at], record.exogenous[at])
    low, high = bounds(plant.actions, device=at.device)
    return (2.0 * policy(observations) / (high - low)).flatten()
