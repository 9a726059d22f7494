r"""What a policy costs on the real system: a belief over policies, learned from the real episodes.

The twin flies each real episode again with the same weights from the same state under the same inputs, so that luck
cancels. What is left is the paired difference :math:`d_i = \log J_i - \log\hat J_i`. A Gaussian process of d over
policies, whose distance is that of their actions, says how wrong the twin is about a policy that has not flown,

.. math::
    k(\pi, \pi') = \sigma^2\Big(c + (1 - c)\exp\big(-\tfrac12\|a_\pi - a_{\pi'}\|^2/\ell^2\big)\Big)

Here a_π are the actions of a policy in some observations of the real system, in shares of half their ranges, and the
norm is the root mean square. The data choose σ: a twin that has been right keeps the word. The cost that is expected on
the real system is :math:`\hat J e^{m + s^2/2}`, with mean m and variance s² of d; plans, updates, clones and the
referee of step 6 compare this one.
"""

import copy
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor, nn
from torch.utils._pytree import tree_flatten

from rt_torchrl.plants.signal import bounds
from rt_torchrl.steps.config import Role
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.report import findings, same_architecture
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory, batch_of, control_cost

if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor

HISTORY = 20
"""Number of latest real episodes that the belief is learned from."""
OBSERVATIONS = 64
"""Number of observations in which policies are compared."""
COMMON = 0.04
"""Share c of the error's variance that all policies have in common."""
LENGTH = 0.1
"""Distance ℓ of neighbours, as an RMS difference of their actions in shares of half the ranges."""
AMPLITUDE = (0.02, 2.0)
"""Least and greatest σ. The least one costs a policy that never flew 0.02 %: on a right twin small gains count."""
NOISE = 0.05
"""Standard deviation of d for one episode: what the replay does not repeat."""
EXPLORED = 2.0
"""Standard deviation of d for each unit of exploration, as a share of half the ranges."""
CHEAPER, DEARER = -1.0, 5.0
"""Least and greatest d that count. A twin that says more than e times the real cost blows up where the real system does
not, and need not do so with the neighbours of a policy. Beyond e⁵ it does not matter how wrong a prediction is."""
QUIET = 0.02
"""Exploration above which the cost of an episode says little about its policy."""
ALARM = 0.15
"""Size of d of two episodes in a row, or half the size of d of one, from which the twin is called wrong."""


class Flown(NamedTuple):
    """A real episode: its trajectory, the role and weights of the policy that flew it, its J_a and its exploration."""

    trajectory: Trajectory
    role: Role
    weights: dict[str, Tensor]
    cost: float
    exploration: float = 0.0


class Judged(NamedTuple):
    """What a policy costs; the smaller one is the better one.

    Attributes:
        expected: the cost that is expected on the real system, extreme episodes included.
        price: mean J_a on the twin, with the price of leaving bounds; it decides where extreme episodes diverge anyway.
    """

    expected: float
    price: float


class Belief:
    """The belief about the cost of policies on the real system; the module says how.

    Args:
        policies: both policies, by role; a copy of the one that flew an episode takes the weights of that episode.
        virtual: virtual episodes of the twin.
        corrects: whether policies are judged by the belief; without it the twin has the word, as in the paper.
    """

    def __init__(self, policies: Mapping[Role, nn.Module], virtual: VirtualEpisodes, *, corrects: bool = True):
        self.virtual, self.corrects = virtual, corrects
        self._policies = policies
        self.flown: list[Flown] = []
        self._differences: tuple[Any, list[float]] | None = None
        self._process: GaussianProcessRegressor | None = None

    def append(
        self,
        trajectory: Trajectory,
        role: Role,
        cost: float,
        exploration: float = 0.0,
        weights: Mapping[str, Tensor] | None = None,
    ) -> None:
        """Add an episode that the policy with this role has just flown, with its present weights or with others.

        Raises:
            ValueError: if the cost is negative, because differences are logs of the ratio of two costs.
        """
        if cost < 0.0 and self.corrects:
            raise ValueError(
                f"J_a={cost:.4g} of a real episode of plant {self.virtual.twin.plant.name!r} is negative; a training "
                "with a twin compares costs by their ratio. Let running_cost and terminal_cost of the plant add a "
                "constant that keeps them positive, or penalise squares of errors; arm='model_free' takes any cost."
            )
        weights = self._policies[role].state_dict() if weights is None else weights
        weights = {name: weight.detach().clone() for name, weight in weights.items()}
        self.flown = [*self.flown, Flown(trajectory, role, weights, cost, exploration)][-HISTORY:]
        self._differences = None

    def policy_of(self, flown: Flown) -> nn.Module:
        """The policy that flew an episode, with the weights that it had in it."""
        policy = copy.deepcopy(self._policies[flown.role])
        policy.load_state_dict(flown.weights)
        return policy

    @torch.no_grad()
    def differences(self) -> list[float]:
        """The paired differences of the episodes on the present twin, which flies them again only if it has changed.

        Episodes of state feedback count as none, with NaN: its flights on the twin take too long.
        """
        state = self.virtual.twin.state_dict()
        if self._differences is None or not equal(state, self._differences[0]):
            self._differences = copy.deepcopy(state), [self._difference(one) for one in self.flown]
            self._process = None
        return self._differences[1]

    def _difference(self, flown: Flown) -> float:
        if isinstance(self._policies[flown.role], StateFeedback):
            return math.nan
        predicted = self.virtual.cost(self.policy_of(flown), self.virtual.repeated(flown.trajectory))
        return difference(flown.cost, predicted)

    def examine(self) -> TensorDict:
        """Fly the latest real episodes on the present twin.

        Returns:
            ``paired_difference`` of the last episode, and ``alarm``, with a ``warning`` in words if it is 1. Nothing if
            state feedback flew it.
        """
        found = self.differences()
        if not found or math.isnan(found[-1]):
            return findings()
        quiet = [d for d, one in zip(found, self.flown, strict=True) if one.exploration <= QUIET and not math.isnan(d)]
        said = alarm(quiet)
        report = findings(paired_difference=found[-1], alarm=float(said is not None))
        if said is None:
            return report
        return report.set_non_tensor("warning", f"{said}; {self.virtual.twin.explanation()}".rstrip("; "))

    @property
    def unexplained(self) -> float:
        """Size of the last paired difference beyond what exploration explains."""
        found = self.differences()
        if not found or math.isnan(found[-1]):
            return 0.0
        explored = self.flown[-1].exploration
        return abs(found[-1]) if explored <= QUIET else abs(found[-1]) - 2.0 * EXPLORED * explored

    @torch.no_grad()
    def replayed(self, records: Sequence[Trajectory]) -> float:
        """Greatest size of the paired differences of records whose actions the twin replays.

        It takes the place of :attr:`unexplained` where no policy can fly them again.
        """
        whole, twin = batch_of(records), self.virtual.twin
        try:
            flown = twin.replay(whole.states[:, 0], whole.exogenous, whole.actions, start=whole.start)
        except DivergenceError:
            return DEARER
        real, predicted = (control_cost(twin.plant, one).tolist() for one in (whole, flown))
        return max(abs(difference(*pair)) for pair in zip(real, predicted, strict=True))

    def judge(self, policy: nn.Module, episodes: Scenario) -> Judged:
        """What a policy costs, by its flights in virtual episodes and by the belief."""
        cost, price = self.virtual.judge(policy, episodes)
        return Judged(self.expected(policy, cost), price)

    def expected(self, policy: nn.Module, cost: float) -> float:
        """The cost that is expected of a policy on the real system, where it has this cost on the twin."""
        if not self.corrects or not 0.0 < cost < math.inf:
            return cost
        self.differences()
        if self._process is None:
            self._process = self._learned()
        if self._process is None:
            return cost
        mean, deviation = self._process.predict(self._actions(policy)[None], return_std=True)
        return cost * math.exp(mean.item() + 0.5 * deviation.item() ** 2)

    def _learned(self) -> "GaussianProcessRegressor | None":
        """The process given all episodes; None without any."""
        # Here, because it takes a second to load.
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel

        pairs = [(d, one) for d, one in zip(self.differences(), self.flown, strict=True) if not math.isnan(d)]
        if not pairs:
            return None
        values = np.clip([d for d, _ in pairs], CHEAPER, DEARER)
        noise = np.array([NOISE**2 + (EXPLORED * one.exploration) ** 2 for _, one in pairs])
        near = ConstantKernel(1.0 - COMMON, "fixed") * RBF(LENGTH, "fixed")
        least, greatest = (sigma**2 for sigma in AMPLITUDE)
        kernel = ConstantKernel(least, (least, greatest)) * (ConstantKernel(COMMON, "fixed") + near)
        process = GaussianProcessRegressor(kernel, alpha=noise)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a twin that is right has the least σ
            return process.fit(np.stack([self._actions(self.policy_of(one)) for _, one in pairs]), values)

    @torch.no_grad()
    def _actions(self, policy: nn.Module) -> Float[np.ndarray, " m"]:
        """A policy's actions in some observations of the last real episode, whose distance is their RMS difference."""
        plant, record = self.virtual.twin.plant, self.flown[-1].trajectory
        n = len(record.actions)
        at = torch.linspace(0, n - 1, min(n, OBSERVATIONS), device=record.states.device).round().long()
        width = len(at) * len(plant.actions)
        if isinstance(policy, StateFeedback):  # no function of an observation, and no neighbour of a policy
            return np.full(width, 10.0 / math.sqrt(width))
        observations = plant.observe(record.start + at.double() * plant.dt, record.states[at], record.exogenous[at])
        low, high = bounds(plant.actions, device=at.device)
        shares = 2.0 * policy(observations) / (high - low)
        return shares.flatten().cpu().numpy() / math.sqrt(width)

    @property
    def contradicted(self) -> bool:
        """Whether a real episode cost more than the twin says, beyond chance and what exploration explains."""
        pairs = zip(self.differences(), self.flown, strict=True)
        return any(d - 2.0 * EXPLORED * one.exploration > ALARM for d, one in pairs)

    def best_flown(self, like: nn.Module, episodes: Scenario) -> tuple[dict[str, Tensor], Judged] | None:
        """The weights that are expected to cost least of all that have flown in an architecture; None if none has."""
        different: list[Flown] = []
        for one in self.flown:
            if not any(equal(one.weights, other.weights) for other in different):
                different.append(one)
        flown = [policy for policy in map(self.policy_of, different) if same_architecture(policy, like)]
        if not flown:
            return None
        costs = [self.judge(policy, episodes) for policy in flown]
        return flown[costs.index(min(costs))].state_dict(), min(costs)

    def require_sound_twin(self, episodes: Scenario) -> None:
        """Refuse a closure under which the twin diverges with the weights that have just flown on the real system.

        Raises:
            DivergenceError: if it does.
        """
        if not math.isfinite(self.virtual.cost(self.policy_of(self.flown[-1]), episodes)):
            twin = self.virtual.twin
            raise DivergenceError(
                f"plant {twin.plant.name!r} diverged on its twin with the weights that have just flown on the real "
                f"system; the closure is {type(twin.closure).__name__}."
            )

    def state_dict(self) -> dict[str, Any]:
        return {"flown": [one._asdict() | {"trajectory": one.trajectory._asdict()} for one in self.flown]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.flown = [Flown(**one | {"trajectory": Trajectory(**one["trajectory"])}) for one in state["flown"]]
        self._differences = self._process = None


def difference(real: float, predicted: float) -> float:
    """The paired difference d of an episode, at most e⁵ times; that if the twin diverges, although nothing did.

    Costs above zero have a ratio; of others, as of a perfect one, the difference is taken as zero.
    """
    if not math.isfinite(predicted):
        return DEARER
    if not (real > 0.0 and predicted > 0.0):
        return 0.0
    return max(-DEARER, min(DEARER, math.log(real / predicted)))


def alarm(differences: Sequence[float]) -> str | None:
    """What is wrong with the twin, in plain words; None if nothing is.

    Args:
        differences: d of the latest quiet episodes, oldest first.
    """
    last = list(differences[-2:])
    if len(last) == 2 and (min(last) > ALARM or max(last) < -ALARM):
        return wrong(last)
    return wrong(last[-1:]) if last and abs(last[-1]) > 2.0 * ALARM else None


def wrong(differences: Sequence[float]) -> str:
    """What is wrong with a twin of which the last episodes have these differences, in plain words."""
    mean = sum(differences) / len(differences)
    ratio, n = math.exp(abs(mean)), len(differences)
    episodes = "the last episode cost" if n == 1 else f"the last {n} episodes cost"
    relation = f"{ratio:.3g} times as much as" if mean > 0.0 else f"1/{ratio:.3g} of what"
    return f"the twin is wrong where it matters: {episodes} {relation} the twin says of {'it' if n == 1 else 'them'}"


def equal(state: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two states, of a twin or of a policy, are the same."""
    (one, structure), (two, its_structure) = tree_flatten(state), tree_flatten(other)
    return structure == its_structure and all(
        torch.equal(a, b) if isinstance(a, Tensor) else a == b for a, b in zip(one, two, strict=True)
    )
