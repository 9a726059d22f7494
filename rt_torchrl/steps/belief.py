r"""What a policy costs on the real system: a belief over policies, learned from the real episodes.

The twin flies each of the latest real episodes again under the policy, alone and with what it did not explain of the
episode (:mod:`~rt_torchrl.trajectories.anchored`). The log of the ratio, :math:`c_i(\pi)`, corrects what the twin says,
the better the nearer the policy is to the one that flew: its error has the variance

.. math:: s_i^2 = \sigma^2 + n_iv\,\|\pi - \pi_i\|^2, \qquad n_i = \sum_j e^{-\|\pi_i - \pi_j\|^2/2\ell^2}

with the mean square of the difference of actions, in shares of half their ranges. What other inputs change, σ, is
independent in each episode; what the distance hides is the same for all n_i episodes that policies like this one
flew. A c_i below zero and below that of every flight counts as the lowest of these: where a closed loop falls on the
twin, its replay with what the twin did not explain may chance not to. The corrections are averaged,

.. math:: m = s^2\sum_ic_i/s_i^2, \qquad s^{-2} = \sum_is_i^{-2}

and the cost that is expected on the real system is :math:`\hat Je^{m + s^2/2}`, with Ĵ of virtual episodes. Plans over
whole episodes descend this one; updates of a live π_mf, clones and the referee of step 6 compare it. Of weights that
flew, their own n flights alone count: m is the mean of their paired differences and :math:`s^2 = \sigma^2/n`, so that
what a real episode refuted does not come back because policies like it were cheap. How well the episodes predict each
other chooses σ and v. A twin that says of all these episodes, with what they explored, what they cost, within 5 % and
what noise of the sensors (:func:`~rt_torchrl.fit.sensors.noise_levels`) explains, is believed as it is.
"""

import contextlib
import copy
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional

from rt_torchrl.plants.shapes import Actions
from rt_torchrl.plants.signal import bounds
from rt_torchrl.steps.config import Pilot, Role
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.report import metrics, same_architecture
from rt_torchrl.systems.operation import FIRST
from rt_torchrl.trajectories.anchored import Anchored, AnchoredReplays
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory, batch_of, whole_cost
from rt_torchrl.trajectories.twin import DigitalTwin

HISTORY = 20
"""Number of latest real episodes that are kept."""
ANCHORS = 8
"""Number of latest whole episodes whose anchored replays plans descend on; policies are judged by those of all."""
NOISE = 0.05
"""Least standard deviation σ of the correction by an episode that was flown with the policy, and what is expected."""
LENGTH = 0.1
"""Distance ℓ of policies that are alike."""
GROWTH = 10.0
"""The v that is expected beforehand, as a multiple of the mean square of the corrections of what flew."""
PRIOR = 2.0
"""Number of episodes that what is expected of σ and v counts for."""
ROUNDING = 1e-9
"""Greatest deviation from a policy's actions, as a share of their ranges, that is rounding."""
DEARER = 5.0
"""Greatest size of d that counts. Beyond e⁵ it does not matter how wrong a prediction is."""
ALARM = 0.15
"""Size of d of two episodes in a row, or half the size of d of one, from which the twin is called wrong."""
NOISY_FLIGHTS = 16
"""Number of flights that say what noise of the sensors changes in the cost of an episode."""


class Flown(NamedTuple):
    """A real episode: its trajectory, the role and weights of the policy that flew it, and its J_a.

    ``role`` is ``first`` for the controller that flew first. ``deviation`` is what the episode has explored beside the
    policy's actions; None for nothing.
    """

    trajectory: Trajectory
    role: Pilot
    weights: dict[str, Tensor]
    cost: float
    deviation: Tensor | None = None


class Compared(NamedTuple):
    """A real episode beside the same one on the present twin; not numbers where state feedback flew it.

    Attributes:
        predicted: J_a that the twin says; infinite where it diverges.
        d: the paired difference.
        beyond_noise: the paired difference beyond what other noise of the sensors explains of a large one.
    """

    predicted: float
    d: float
    beyond_noise: float


class Judged(NamedTuple):
    """What a policy costs; the smaller one is the better one.

    Attributes:
        expected: the cost that is expected on the real system, extreme episodes included.
        without_extremes: what decides where extreme episodes diverge anyway: the cost that is expected without them.
        on_twin: mean J_a on the twin.
    """

    expected: float
    without_extremes: float
    on_twin: float


class BesideFirst(NamedTuple):
    """What a policy costs beside the controller that flew first.

    Attributes:
        expected: the cost that is expected of the policy where the controller has cost ``paid``.
        paid: mean cost of the controller's real episodes.
        right: whether the twin says what all flights have cost; False where this was not asked.
    """

    expected: float
    paid: float
    right: bool = False


class Anchors(NamedTuple):
    """What the latest real episodes say of other policies.

    Attributes:
        replays: the anchored replays.
        noise: variance σ² of their corrections.
        growth: its growth v with the distance.
        least: least correction that counts, the lowest of what flew, or zero.
    """

    replays: AnchoredReplays
    noise: float
    growth: float
    least: float


class Belief:
    """The belief about the cost of policies on the real system; the module says how.

    Args:
        policies: both policies, by role; a copy of the one that flew an episode takes the weights of that episode.
        virtual: virtual episodes of the twin.
        corrects: whether policies are judged by the belief; without it the twin has the word, as in the paper.
    """

    def __init__(self, policies: Mapping[Role, nn.Module], virtual: VirtualEpisodes, *, corrects: bool = True):
        self.virtual, self.corrects = virtual, corrects
        self.policies = policies
        self.flown: list[Flown] = []
        self.first: list[Flown] = []
        """The latest episodes of the controller that flew first."""
        self._state: dict[str, Any] | None = None
        self._results: dict[Hashable, Any] = {}
        self._twins: dict[DigitalTwin, DigitalTwin] = {}
        self._copies: dict[Role, nn.Module] = {}
        virtual.twin.correct(partial(self.correction, latest=ANCHORS) if corrects else None)

    def append(
        self,
        trajectory: Trajectory,
        role: Pilot,
        cost: float,
        weights: Mapping[str, Tensor] | None = None,
        commands: Float[Tensor, "n n_a"] | None = None,
    ) -> None:
        """Add an episode that the policy with this role has just flown, with its present weights or with others.

        Args:
            trajectory: what sensors have read, and what was applied.
            role: role of the policy; ``first`` for the controller with which the training has begun.
            cost: J_a as measured.
            weights: weights of the policy; None for the present ones.
            commands: commands with what they have explored; None for those of the policy.

        Raises:
            ValueError: if the cost is negative, because differences are logs of the ratio of two costs.
        """
        if cost < 0.0 and self.corrects:
            raise ValueError(
                f"J_a={cost:.4g} of a real episode of plant {self.virtual.twin.plant.name!r} is negative; a training "
                "with a twin compares ratios of costs: let its costs add a constant, or use arm='model_free'."
            )
        if role == FIRST:
            self.first = [*self.first, Flown(trajectory, role, {}, cost)][-ANCHORS:]
            return
        weights = self.policies[role].state_dict() if weights is None else weights
        weights = {name: weight.detach().clone() for name, weight in weights.items()}
        flown = Flown(trajectory, role, weights, cost)
        if commands is not None:
            flown = flown._replace(deviation=self._deviation(flown, commands))
        self.flown = [*self.flown, flown][-HISTORY:]
        self._state = None

    def _kept(self, name: Hashable, compute: Callable[[], Any]) -> Any:
        """What is computed of the present twin and the episodes, once until one of both changes."""
        state = self.virtual.twin.state_dict() | {"noise": self.virtual.twin.noise}
        if self._state is None or not equal(state, self._state):
            self._state, self._results = copy.deepcopy(state), {}
        if name not in self._results:
            self._results[name] = compute()
        return self._results[name]

    @torch.no_grad()
    def _deviation(self, flown: Flown, commands: Float[Tensor, "n n_a"]) -> Float[Tensor, "1 n n_a"] | None:
        """What commands have explored beside those of the policy for the same readings; None where that is nothing."""
        policy, record, plant = self.policy_of(flown), flown.trajectory, self.virtual.twin.plant
        if isinstance(policy, StateFeedback):
            return None
        states = plant.at_rest(record.states[:-1])
        t = record.start + plant.dt * torch.arange(len(states), dtype=torch.float64, device=states.device)
        deviation = commands - policy(plant.observe(t, states, record.exogenous))
        low, high = bounds(plant.actions, device=states.device)
        return deviation.unsqueeze(0) if (deviation.abs() > ROUNDING * (high - low)).any() else None

    @torch.no_grad()
    def beside_first(
        self, policy: nn.Module, controller: nn.Module | None, others: Scenario | None = None
    ) -> BesideFirst | None:
        """Compare a policy with the controller that flew first, in the episodes of this one.

        Before a policy has flown nothing corrects what the twin says of one. It then errs as it errs for the
        controller, which it flies in the same episodes.

        Args:
            policy: the policy.
            controller: the controller; None where no controller flew first.
            others: other episodes in which the twin compares both, too, because one flight holds no rare end.

        Returns:
            None where no controller flew first or it cost nothing, the twin alone has the word, or the policy is state
            feedback, which plans on the twin while it acts.
        """
        flights = self.first if others is None else self.first[-len(others.initial_state) :]
        paid = sum(flight.cost for flight in flights) / max(1, len(flights))
        if controller is None or not self.corrects or paid == 0.0 or isinstance(policy, StateFeedback):
            return None
        theirs = [self.virtual.repeated(flight.trajectory) for flight in flights]
        episodes = theirs if others is None else [*theirs, others]

        def of_controller(episode: Scenario) -> float:
            values = tuple(part.cpu().numpy().tobytes() for part in episode)
            cost: float = self._kept(values, lambda: self.virtual.cost(controller, episode))
            return cost

        def on_twin(cost_of: Callable[[Scenario], float], episodes: Sequence[Scenario]) -> float:
            return sum(map(cost_of, episodes)) / len(episodes)

        cost = on_twin(partial(self.virtual.cost, policy), episodes)
        if self.flown and others is None:
            return BesideFirst(self.expected(policy, cost), paid)
        predicted, rival = on_twin(of_controller, theirs), on_twin(of_controller, episodes)
        if not (0.0 < predicted < math.inf and rival < math.inf):
            return BesideFirst(math.inf, paid)
        error = paid / predicted
        expected = self.expected(policy, cost) if self.flown else error * cost
        right = not self.contradicted and abs(math.log(error)) <= NOISE
        return BesideFirst(expected * predicted / rival, paid, right)

    def policy_of(self, flown: Flown) -> nn.Module:
        """The policy that flew an episode, with the weights that it had in it, until the next call for this role.

        There is one copy for each role, because the twin keeps the code of few modules.
        """
        role = cast(Role, flown.role)
        if role not in self._copies:
            self._copies[role] = copy.deepcopy(self.policies[role])
        policy = self._copies[role]
        policy.load_state_dict(flown.weights)
        return policy

    def compared(self) -> list[Compared]:
        """The episodes beside those on the present twin, which flies them again only if it has changed."""
        compared: list[Compared] = self._kept("flights", lambda: [self._flown_again(flown) for flown in self.flown])
        return compared

    def _flown_again(self, flown: Flown) -> Compared:
        policy, episode = self.policy_of(flown), self.virtual.repeated(flown.trajectory)
        if isinstance(policy, StateFeedback):  # its flights on the twin take too long
            return Compared(math.nan, math.nan, math.nan)
        predicted = self.virtual.cost(policy, episode, explored(flown, episode))
        d, least, greatest = difference(flown.cost, predicted), 0.0, 0.0
        if NOISE < abs(d) < DEARER:  # noise excuses no fall
            least, greatest = self._explained_by_noise(flown)
        return Compared(predicted, d, d - min(max(d, least), greatest))

    @torch.no_grad()
    def _explained_by_noise(self, flown: Flown) -> tuple[float, float]:
        """The least and the greatest paired difference of an episode that noise of the sensors explains.

        They are two standard deviations from the mean of what flights of the twin cost with other noise over that with
        the noise that its costs have, and hold what a flight without noise costs; zeros where the twin diverges.
        """
        twin, (starts, inputs) = self.virtual.twin.believed, self.virtual.repeated(flown.trajectory)
        levels, policy = self.virtual.twin.noise, self.policy_of(flown)
        if not levels.any():
            return 0.0, 0.0
        noise = inputs.new_zeros(1 + NOISY_FLIGHTS, inputs.shape[1], len(levels))
        noise[1:] = levels * torch.randn(noise[1:].shape, generator=torch.Generator().manual_seed(0)).to(noise)
        true_starts = twin.plant.at_rest(starts - noise[:, 0])  # of which the readings are those of the episode
        scenario = Scenario(true_starts, torch.cat([inputs.expand(len(noise), -1, -1), noise], -1))
        episode = Scenario(twin.plant.at_rest(starts), inputs)
        try:
            costs = twin.noisy.episode_costs(policy, *scenario, explored(flown, scenario))
            logs = (costs / twin.episode_costs(policy, *episode, explored(flown, episode))).log()
        except DivergenceError:
            return 0.0, 0.0
        mean, spread = logs[1:].mean().item(), 2.0 * logs[1:].std().item()
        ends = (0.0, logs[0].item(), mean - spread, mean + spread)
        return (min(ends), max(ends)) if all(map(math.isfinite, ends)) else (0.0, 0.0)

    def examine(self) -> TensorDict:
        """Fly the latest real episodes on the present twin.

        Returns:
            ``paired_difference`` of the last episode, and ``alarm``, with a ``warning`` in words if it is 1. Nothing if
            state feedback flew it.
        """
        known = [flight for flight in self.compared() if not math.isnan(flight.d)]
        if not known or known[-1] is not self.compared()[-1]:
            return metrics()
        warning, hypothesis = alarm([flight.beyond_noise for flight in known]), self.virtual.twin.hypothesis
        report = metrics(paired_difference=known[-1].d, alarm=float(warning is not None))
        if warning is None:
            return report
        explained = "" if hypothesis is None else f"; {hypothesis!r} explains the records best"
        return report.set_non_tensor("warning", warning + explained)

    @property
    def unexplained(self) -> float:
        """Size of the last paired difference beyond what noise of the sensors explains; 0 where there is none."""
        last = self.compared()[-1:]
        return abs(last[0].beyond_noise) if last and not math.isnan(last[0].d) else 0.0

    @torch.no_grad()
    def replayed(self, records: Sequence[Trajectory], n: int) -> float:
        """Greatest size of the paired differences of records whose actions the twin replays.

        It takes the place of :attr:`unexplained` where no policy can fly them again.

        Args:
            records: the records, of equal length.
            n: number of intervals that count, which are more than those of records that ended early.
        """
        whole, twin = batch_of(records), self.virtual.twin
        try:
            flown = twin.replay(whole.states[:, 0], whole.exogenous, whole.actions, start=whole.start)
        except DivergenceError:
            return DEARER
        real, predicted = (whole_cost(twin.plant, flights, n).tolist() for flights in (whole, flown))
        return max(abs(difference(*pair)) for pair in zip(real, predicted, strict=True))

    def judge(self, policy: nn.Module, episodes: Scenario) -> Judged:
        """What a policy costs, by its flights in virtual episodes and by the belief."""
        cost, on_twin = self.virtual.judge(policy, episodes)
        expected = self.expected(policy, cost)
        return Judged(expected, expected if math.isfinite(cost) else self.expected(policy, on_twin), on_twin)

    @torch.no_grad()
    def expected(self, policy: nn.Module, cost: float) -> float:
        """The cost that is expected of a policy on the real system, where it has this cost on the twin."""
        if not self.corrects or not 0.0 < cost < math.inf:
            return cost
        weights = {name: weight.clone() for name, weight in policy.state_dict().items()}
        pairs = zip(self.compared(), self.flown, strict=True)
        flown = [again.d for again, flight in pairs if equal(flight.weights, weights)]
        try:
            if self.contradicted and flown and not any(map(math.isnan, flown)):
                anchors = self.anchors()
                noise = NOISE**2 if anchors is None else anchors.noise
                return cost * math.exp((sum(flown) + 0.5 * noise) / len(flown))
            return cost * math.exp(min(DEARER, self.correction(policy).item()))
        except DivergenceError:
            return math.inf

    def correction(self, policy: nn.Module, *, latest: int = HISTORY) -> Float[Tensor, ""]:
        """The log m + s²/2 of the expected cost over the twin's, differentiable by the policy's weights.

        It is zero while the twin is right, and for state feedback, which is no function of an observation.

        Args:
            policy: the policy.
            latest: number of latest whole episodes that it comes from.

        Raises:
            DivergenceError: if a replay diverges under the policy.
        """
        anchors = self.anchors()
        if anchors is None or isinstance(policy, StateFeedback):
            return torch.zeros((), dtype=torch.float64, device=self.virtual.generator.device)
        replays = anchors.replays.latest(latest)
        distances = (replays.actions(policy) - replays.flown).square().sum(-1) + replays.explored
        alike = torch.exp(-0.5 * replays.distances() / LENGTH**2).sum(-1)
        precisions = 1.0 / (anchors.noise + anchors.growth * alike * distances)
        corrections = replays.corrections(policy).clamp_min(anchors.least)
        return ((precisions * corrections).sum() + 0.5) / precisions.sum()

    @property
    def contradicted(self) -> bool:
        """Whether an episode cost other than the present twin says, beyond what noise of the sensors explains."""
        return any(abs(flight.beyond_noise) > NOISE for flight in self.compared())

    def anchors(self) -> "Anchors | None":
        """The latest whole episodes that the present twin flies; None without any, and while the twin is right."""
        anchors: Anchors | None = self._kept("anchors", lambda: self._anchors_on(self.virtual.twin.believed))
        return anchors

    @torch.no_grad()
    def _anchors_on(self, twin: DigitalTwin) -> "Anchors | None":
        if not self.contradicted:
            return None
        known = list[tuple[Flown, Tensor, float]]()
        for flown, (predicted, d, _) in zip(self.flown, self.compared(), strict=True):
            exogenous = self.virtual.repeated(flown.trajectory).exogenous
            # State feedback is no function of an observation, a part of an episode has another cost, and where the
            # twin diverges, or nearly does, nothing is near.
            if exogenous.shape[1] == twin.plant.n_steps and math.isfinite(predicted) and d > -DEARER:
                known.append((flown, exogenous, d))
        if not known:
            return None
        whole, inputs, differences = zip(*known, strict=True)
        anchored = self._twins.get(twin)
        if anchored is None or anchored.closure is not twin.closure:
            anchored = self._twins[twin] = twin.of(Anchored(twin.plant))
        replays = AnchoredReplays(
            self.virtual.twin,
            anchored,
            [flown.trajectory for flown in whole],
            torch.cat(inputs),
            torch.tensor([flown.cost for flown in whole], dtype=torch.float64, device=inputs[0].device),
            lambda k: self.policy_of(whole[k]),
        )
        variances = self._variances(replays.latest(ANCHORS), whole[-ANCHORS:], differences[-ANCHORS:])
        return Anchors(replays, *variances, min(0.0, *differences))

    def _variances(
        self, replays: AnchoredReplays, flown: Sequence[Flown], differences: Sequence[float]
    ) -> tuple[float, float]:
        """The most likely σ² and v, by how well each episode predicts the corrections of the others.

        Args:
            replays: anchored replays.
            flown: their episodes.
            differences: the paired differences of these.
        """
        corrections, others = replays.offsets.new_empty(len(flown), len(flown)), ~torch.eye(len(flown)).bool()
        for k, episode in enumerate(flown):
            try:
                corrections[k] = replays.corrections(self.policy_of(episode))
            except DivergenceError:  # of the others, not of the episode itself
                corrections[k] = DEARER
                corrections[k, k] = differences[k]
        own_corrections = corrections.diag()
        errors = (own_corrections.unsqueeze(-1) - corrections)[others].clamp(-DEARER, DEARER).square().cpu().numpy()
        explored = replays.explored + replays.explored.unsqueeze(-1)
        distances = (replays.distances() + explored)[others].cpu().numpy()
        noise, growth = NOISE**2, GROWTH * max(NOISE**2, own_corrections.square().mean().item())
        share = 1.0 / max(1, len(flown) - 1)

        def unlikely(logs: np.ndarray) -> float:
            sigma, v = np.exp(logs)
            spread = 2.0 * sigma + v * distances
            misfit = share * (np.log(spread) + errors / spread).sum()
            return float(misfit + PRIOR * (logs.sum() + noise / sigma + growth / v))

        start = np.log([noise, growth])
        bounds = [(start[0], start[0] + 6.0), (start[1] - 5.0, start[1] + 5.0)]
        sigma, v = np.exp(minimize(unlikely, start, method="L-BFGS-B", bounds=bounds).x)
        return float(sigma), float(v)

    def best_flown(self, like: nn.Module, episodes: Scenario) -> tuple[dict[str, Tensor], Judged] | None:
        """The weights that are expected to cost least of the last that have flown in an architecture; None without."""
        best: tuple[dict[str, Tensor], Judged] | None = None
        seen = list[dict[str, Tensor]]()
        with contextlib.suppress(DivergenceError):  # which the judgements below meet again
            self.anchors()  # now, because it takes the copies of the policies that are judged below
        for flown in self.flown[-ANCHORS:]:
            policy = self.policy_of(flown)
            if any(equal(flown.weights, weights) for weights in seen) or not same_architecture(policy, like):
                continue
            seen.append(flown.weights)
            judged = self.judge(policy, episodes)
            if best is None or judged < best[1]:
                best = copy.deepcopy(flown.weights), judged
        return best

    def require_sound_twin(self, episodes: Scenario) -> None:
        """Refuse a closure under which the twin diverges with the weights that have just flown on the real system.

        A twin that says e⁵ times what the last real episode cost diverges, too, and so does one that says e⁵ times what
        any of the latest real episodes cost of virtual ones, and one that diverges within an interval from where a real
        episode has been: nothing that it says of a plan counts.

        Raises:
            DivergenceError: if it does.
        """
        if not self.flown:
            return
        twin, last = self.virtual.twin, self.flown[-1]
        again, elsewhere = self.compared()[-1].predicted, self.virtual.cost(self.policy_of(last), episodes)
        pairs = [(last.cost, again), (max(flown.cost for flown in self.flown), elsewhere)]
        if any(math.isinf(predicted) or difference(real, predicted) <= -DEARER for real, predicted in pairs):
            raise DivergenceError(
                f"plant {twin.plant.name!r} diverged on its twin, or cost there e⁵ times what real episodes did, with "
                f"the weights that have just flown on the real system; the closure is {type(twin.closure).__name__}."
            )
        if self.corrects:
            self.anchors()  # raises where the twin diverges within an interval from what was read

    def state_dict(self) -> dict[str, Any]:
        return {"flights": [f._asdict() | {"trajectory": f.trajectory._asdict()} for f in (*self.first, *self.flown)]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        flights = [Flown(**saved | {"trajectory": Trajectory(**saved["trajectory"])}) for saved in state["flights"]]
        self.first = [flight for flight in flights if flight.role == FIRST]
        self.flown = [flight for flight in flights if flight.role != FIRST]
        self._state = None


def explored(flown: Flown, episodes: Scenario) -> Actions | None:
    """What an episode has explored, to the horizon of each of the episodes in which it is flown again."""
    count, n, _ = episodes.exogenous.shape
    if flown.deviation is None:
        return None
    return functional.pad(flown.deviation, (0, 0, 0, n - flown.deviation.shape[1])).expand(count, -1, -1)


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
        differences: d of the latest episodes, oldest first.
    """
    last = list(differences[-2:])
    if len(last) < 2 or not (min(last) > ALARM or max(last) < -ALARM):
        last = [d for d in last[-1:] if abs(d) > 2.0 * ALARM]
    if not last:
        return None
    ratio, n = math.exp(sum(last) / len(last)), len(last)
    return f"the twin is wrong where it matters: the latest real costs ({n}) were {ratio:.3g} times what it says"


def equal(state: Any, other: Any) -> bool:
    """Whether two states, of a twin or of a policy, are the same, whatever mappings hold them in whatever order."""
    if isinstance(state, Tensor):
        return isinstance(other, Tensor) and state.dtype == other.dtype and torch.equal(state, other)
    if isinstance(state, Mapping):
        return (
            isinstance(other, Mapping)
            and state.keys() == other.keys()
            and all(equal(value, other[key]) for key, value in state.items())
        )
    if isinstance(state, list | tuple):
        return type(state) is type(other) and len(state) == len(other) and all(map(equal, state, other))
    return bool(state == other)
