"""Step 3: the exogenous inputs of virtual episodes, and these episodes.

A Gaussian process around the large scale of a recorded input gives other possible inputs. Virtual episodes draw from
the processes of the latest real episodes, and policies are compared in them.
"""

import copy
import math
from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Complex, Float
from tensordict import TensorDictBase
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Actions
from rt_torchrl.plants.signal import Signal, bounds
from rt_torchrl.steps.config import ExogenousConfig
from rt_torchrl.steps.report import Step, record_of
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory, continued, pieces_of_equal_length
from rt_torchrl.trajectories.twin import DigitalTwin

ENOUGH = 3
"""Number of episodes from which on their large scales say how much others may differ."""


class ExogenousProcess:
    r"""Gaussian process of one recorded episode, :math:`\mathcal N_z(\tilde d(t), \Sigma_\varepsilon)`.

    The large scale d̃ of each component is a support vector regression with a Gaussian kernel (paper, eq. svr), fitted
    to block means of the record, and shifted to the mean of the record. The residuals z − d̃ are taken to be jointly
    stationary: components that moved together in the record, at once or one after the other, do so in every realisation
    too. Their covariances,

    .. math:: \Gamma_{kl}(h) = \mathrm E\,\varepsilon_k(t + h)\,\varepsilon_l(t)

    are the sample covariances times a Parzen window, which keeps them positive semi-definite. Circulant embedding
    samples them exactly. The large scales themselves do not vary between realisations, unless they are mixed.

    Args:
        mean: large scale d̃.
        covariance: covariances Γ at the lags 0 to n − 1; Γ at a negative lag is the transpose of Γ at the positive lag.
        signals: signals of the inputs, of which there may be none; samples stay within their physical ranges.

    Source: Dietrich and Newsam, SIAM J. Sci. Comput. 18 (1997) 1088, of the sampling.
    """

    def __init__(self, mean: Float[Tensor, "n n_z"], covariance: Float[Tensor, "n n_z n_z"], signals: Sequence[Signal]):
        self.mean, self.covariance, self._root = mean, covariance, _spectral_root(covariance)
        self._low, self._high = bounds(signals, dtype=mean.dtype, device=mean.device)

    @classmethod
    def of(
        cls, record: Float[Tensor, "n n_z"], *, signals: Sequence[Signal], config: ExogenousConfig
    ) -> "ExogenousProcess":
        """The process of a record of the input at every control interval."""
        like = partial(torch.as_tensor, dtype=record.dtype, device=record.device)
        # Columns are written in place: a plant without inputs has none to stack.
        values = record.cpu().numpy()
        large = np.empty_like(values)
        for k, column in enumerate(values.T):
            large[:, k] = _large_scale(column, config)
        large += (values - large).mean(0)  # what a regression with a tube leaves over, and no sample would have
        return cls(like(large), like(_windowed_covariance(values - large)), signals)

    def sample(
        self, count: int, generator: torch.Generator, large: Float[Tensor, "{count} n n_z"] | None = None
    ) -> Float[Tensor, "{count} n n_z"]:
        """Realisations of the input, within the physical ranges of the signals.

        Args:
            count: number of realisations.
            generator: source of the draws.
            large: large scale of each; by default that of the record.
        """
        n, n_z = self.mean.shape
        shape = (count, 2 * n, n_z)
        noise = torch.complex(
            *(torch.randn(shape, generator=generator, dtype=self.mean.dtype, device=self.mean.device) for _ in range(2))
        )
        coloured = (self._root * noise.unsqueeze(-2)).sum(-1)
        small = torch.fft.fft(coloured, dim=1).real[:, :n]
        return ((self.mean if large is None else large) + small).clamp(self._low, self._high)


def sample_experience(
    processes: Sequence[ExogenousProcess], count: int, generator: torch.Generator, *, mix: bool = False
) -> Float[Tensor, "{count} n n_z"]:
    """Realisations from the processes of several episodes, in random order; each is drawn once before any is again.

    Args:
        processes: processes of the episodes.
        count: number of realisations.
        generator: source of the draws.
        mix: whether their large scales are :func:`mixed` where there are three of them, of which fewer do not tell how
            much others may differ.
    """
    rounds = -(-count // len(processes))
    order = [torch.randperm(len(processes), generator=generator, device=generator.device) for _ in range(rounds)]
    chosen, larges = torch.cat(order)[:count].tolist(), [None] * count
    if mix and len(processes) >= ENOUGH:
        larges = mixed([process.mean for process in processes], count, generator).split(1)
    pairs = zip(chosen, larges, strict=True)
    return torch.cat([processes[k].sample(1, generator, large) for k, large in pairs])


def mixed(
    larges: Sequence[Float[Tensor, "n n_z"]], count: int, generator: torch.Generator
) -> Float[Tensor, "{count} n n_z"]:
    r"""New large scales, which differ from the mean of those met as these do from each other.

    .. math::
        \tilde d'(t) = \bar d(t) + \sqrt{\frac{m + 1}{m\,(m - 1)}}\;
            \sum_{j=1}^m\xi_j\,\big(\tilde d_j(t) - \bar d(t)\big), \qquad \xi_j \sim \mathcal N(0, 1)

    Their covariance is 1 + 1/m times that of those met, because the mean is uncertain, too. All inputs and all times of
    an episode have the same ξ, so that they move together as in the episodes met. The ξ are quasi-random, along the
    principal components of the large scales met: some tens of draws hold rare ones as often as they come. Student's
    distribution, which also knows that few episodes leave the covariance uncertain, is no help: after three episodes
    its tails hold gusts that nothing could fly in, and a plan then considers nothing else.

    Args:
        larges: the m large scales met.
        count: number of new ones.
        generator: source of the new ones.

    Source: Owen, Scrambled net variance for integrals of smooth functions, Ann. Statist. 25 (1997) 1541.
    """
    m, stacked = len(larges), torch.stack(list(larges))
    centre = stacked.mean(0)
    changes = (stacked - centre) / (stacked - centre).square().mean((0, 1)).sqrt().clamp_min(1e-300)  # of one unit
    components = torch.linalg.eigh(changes.flatten(1) @ changes.flatten(1).T).eigenvectors.flip(1)
    seed = int(torch.randint(2**31, (), generator=generator, device=generator.device))
    unit = torch.quasirandom.SobolEngine(m, scramble=True, seed=seed).draw(count, dtype=torch.float64)
    normal = torch.special.ndtri(unit.clamp(2.0**-31, 1.0 - 2.0**-31))
    weights = normal.to(stacked) @ components.T * ((m + 1) / (m * (m - 1))) ** 0.5
    return centre + torch.einsum("cm,mnz->cnz", weights, stacked - centre)


def _large_scale(values: Float[np.ndarray, " n"], config: ExogenousConfig) -> Float[np.ndarray, " n"]:
    """The large scale d̃ at every sample, from a regression on block means; its time is in knot spacings."""
    from sklearn.svm import SVR  # here, because it takes a second to load and only step 3 needs it

    spread = values.std()
    if spread == 0.0:
        return values.copy()
    block = max(1, -(-len(values) // config.knots))
    blocks = [values[k : k + block] for k in range(0, len(values), block)]
    middles = np.array([k * block + (len(part) - 1) / 2 for k, part in enumerate(blocks)]) / block
    means = np.array([part.mean() for part in blocks])
    regression = SVR(
        kernel="rbf", gamma=0.5 / config.kernel_width**2, C=config.penalty, epsilon=config.tube, cache_size=50
    )
    centre = values.mean()
    regression.fit(middles[:, None], (means - centre) / spread)
    return centre + spread * regression.predict(np.arange(len(values))[:, None] / block)


def _windowed_covariance(residuals: Float[np.ndarray, "n n_z"]) -> Float[np.ndarray, "n n_z n_z"]:
    """Biased sample covariances Γ, times Parzen's window over a quarter of the record."""
    n = len(residuals)
    spectra = [np.fft.rfft(residual - residual.mean(), 2 * n) for residual in residuals.T]
    u = np.arange(n) / max(1, n // 4)
    window = np.where(u <= 0.5, 1.0 - 6.0 * u**2 * (1.0 - u), 2.0 * np.clip(1.0 - u, 0.0, None) ** 3)
    covariance = np.empty((n, len(spectra), len(spectra)))
    for k, first in enumerate(spectra):
        for j, second in enumerate(spectra):
            power = np.abs(first) ** 2 if k == j else first * second.conj()
            covariance[:, k, j] = np.fft.irfft(power, 2 * n)[:n] / n * window
    return covariance


def _spectral_root(covariance: Float[Tensor, "n n_z n_z"]) -> Complex[Tensor, "samples n_z n_z"]:
    """Hermitian roots of the spectrum of the circulant that holds the covariances, divided by the number of lags.

    A covariance of finite support fits exactly into a circulant twice as long; the FFT of the circulant gives its
    eigenvalues.
    """
    circulant = torch.cat([covariance, torch.zeros_like(covariance[:1]), covariance[1:].flip(0).mT])
    # The FFT that makes samples runs backwards in time; without the conjugate, a component that follows would lead.
    values, vectors = torch.linalg.eigh(torch.fft.fft(circulant, dim=0).conj())
    scale = (values.clamp_min(0.0) / len(circulant)).sqrt()  # with a Parzen window only rounding makes them negative
    return (vectors * scale.unsqueeze(-2)) @ vectors.mH


EXTREMES = 1000
"""Number of random initial states among which the extreme ones are found: twenty virtual episodes do not show what a
policy does in one of hundreds."""
DRAWS_SEED = 3_000_000
"""Seed of the draws that tell the extreme states and the set points of a plant: the same for every training."""
DRAWN = 8
"""Number of episodes, and of moments in each, whose inputs tell on which of them no equation depends."""
RARE, FAILURE = 0.01, 10.0
"""Share of all episodes that begin like the extreme ones, and how many times the usual cost they may cost there."""


def extreme_states(plant: Plant, count: int, device: torch.device) -> Float[Tensor, "k n_s"]:
    """The extremes of each state among many random initial states; none of a state that is always the same.

    The weights of a policy that saturates hardly depend on what lies beyond the starts that it was planned on: a plan
    may do the opposite there of what it does everywhere else, and twenty draws do not show it.

    Args:
        plant: the plant, which draws the initial states.
        count: number of random initial states; 0 for no extremes.
        device: device of the states.
    """
    drawn = plant.draw_initial_state(max(count, 1), torch.Generator(device=device).manual_seed(DRAWS_SEED))
    varied = drawn[:, (drawn != drawn[0]).any(0)]
    return drawn[torch.cat([varied.argmin(0), varied.argmax(0)]).unique()]


@torch.no_grad()
def set_points(twin: DigitalTwin, device: torch.device) -> Bool[Tensor, " n_z"]:
    """Which inputs that act are set points: no equation of the plant depends on them, only costs and the controller.

    Who sets them knows how they will be set, which a few episodes do not show. A policy that is planned on the few that
    were met may fail at all others. An equation depends on an input if an interval ends elsewhere with another one, at
    some initial states, states near these, and actions.

    Args:
        twin: the twin, whose plant draws states and inputs.
        device: device of the inputs.
    """
    plant, generator = twin.plant, torch.Generator(device=device).manual_seed(DRAWS_SEED)
    drawn = plant.draw_exogenous(DRAWN, generator)
    moments = torch.linspace(0, plant.n_steps - 1, DRAWN, device=device).long()
    inputs, t = drawn[:, moments].flatten(0, 1), plant.dt * moments.double().repeat(DRAWN)
    like = partial(torch.randn, generator=generator, dtype=torch.float64, device=device)
    sizes = torch.tensor(plant.state_sizes or [1.0] * len(plant.states), dtype=torch.float64, device=device)
    apart = sizes * like(len(inputs), len(plant.states))
    apart[::2] = 0.0  # every second state stays where the plant is sound
    states = plant.draw_initial_state(len(inputs), generator) + apart
    outside = [k for k, signal in enumerate(plant.states) if signal.name not in plant.controller_states]
    low, high = (bound.nan_to_num(posinf=1.0, neginf=-1.0) for bound in bounds(plant.actions, device=device))
    actions = low + (high - low) * like(len(inputs), len(plant.actions)).sigmoid()

    varied = copy.deepcopy(twin.closure)  # a weight of an input may be zero before it is trained
    for weight in varied.parameters():
        weight.add_(0.01 * (1.0 + weight.abs()))

    def ends(inputs: Tensor) -> Tensor:
        flown = [plant.step(t, states, actions, inputs, closure) for closure in (twin.closure, varied)]
        return torch.cat([part for end, applied in flown for part in (end[:, outside], applied)], -1).nan_to_num()

    usual, free = ends(inputs), []
    for k in range(len(plant.acting_inputs)):
        others = inputs.clone()
        others[:, k] = inputs[:, k].roll(DRAWN) + 0.01 * (1.0 + inputs[:, k].abs())
        free.append(torch.equal(ends(others), usual))
    return torch.tensor(free, dtype=torch.bool, device=device)


class VirtualEpisodes:
    """Episodes on the twin with the disturbances that the real system has met.

    Args:
        twin: twin on which the episodes are flown.
        config: parameters of the fit of a process to a real episode's exogenous input.
        experience: number of latest real episodes whose processes are kept.
        extremes: number of random initial states whose extremes count where policies are compared; 0 for none.
        generator: source of every draw.
    """

    def __init__(
        self,
        twin: DigitalTwin,
        config: ExogenousConfig,
        experience: int,
        *,
        extremes: int = 0,
        generator: torch.Generator,
    ):
        self.twin, self.config, self.generator = twin, config, generator
        self.processes: deque[ExogenousProcess] = deque(maxlen=experience)
        self.recorded: Tensor | None = None
        """Initial state of the last whole real episode."""
        self.extremes = extreme_states(twin.plant, extremes, generator.device)
        self.set_points = set_points(twin, generator.device)

    def learn(self, record: Trajectory) -> None:
        """Fit a process to the inputs that acted on the plant in a real episode, and keep it and the initial state.

        Those of an episode that ended early are continued to the horizon.
        """
        self.processes.append(self._process(record._replace(exogenous=self.repeated(record).exogenous[0])))
        self.recorded = record.states[0]

    def repeated(self, record: Trajectory) -> Scenario:
        """The start and the inputs of a real episode, which are continued to the horizon if it ended early.

        Previews stay as they were read: those of the last intervals have seen beyond the end.
        """
        plant, inputs = self.twin.plant, record.exogenous
        if len(inputs) < plant.n_steps and plant.end_cost is not None:
            acted = continued(inputs[:, : len(plant.acting_inputs)], plant.n_steps)
            inputs = torch.cat([inputs, plant.with_previews(acted)[len(inputs) :]])
        return Scenario(record.states[:1], inputs[None])

    def paired(self, records: Sequence[Trajectory]) -> tuple[list[Trajectory], list[ExogenousProcess]]:
        """The latest records that have a process, and these processes, in pairs.

        If only a part of an episode is sound, the records differ in length. Then they are cut to pieces of one length,
        and each piece gets a process that is not kept.

        Args:
            records: the latest records, oldest first.
        """
        processes = list(self.processes)[-len(records) :]
        latest = list(records)[-len(processes) :] if processes else []
        if latest and all(len(a.actions) == len(b.mean) for a, b in zip(latest, processes, strict=True)):
            return latest, processes
        plant = self.twin.plant
        pieces = pieces_of_equal_length(records, plant.n_steps, plant.dt)
        return pieces, [self._process(piece) for piece in pieces]

    def _process(self, record: Trajectory) -> ExogenousProcess:
        signals = self.twin.plant.acting_inputs
        acted = record.exogenous[:, : len(signals)]
        return ExogenousProcess.of(acted, signals=signals, config=self.config)

    def draw(self, count: int, *, recorded: bool = False) -> Scenario:
        """Draw initial states, and exogenous inputs from the processes that are kept or as the plant draws them.

        Note: the paper plans with the initial state and the disturbances of the last episode alone. Here the initial
        states are random and the disturbances are those of the last ``experience`` episodes, because a policy that is
        optimal for one wind can lie just beyond a cliff of another: the turbine's torque law then stalls the rotor in
        one wind of twenty. Set points are always as the plant draws them, see :func:`set_points`.

        Args:
            count: number of virtual episodes.
            recorded: whether they all begin as the last real episode did.
        """
        plant = self.twin.plant
        if recorded:
            assert self.recorded is not None  # inputs are drawn once a whole episode is known
            initial_state = self.recorded.repeat(count, 1)
        else:
            initial_state = plant.draw_initial_state(count, self.generator)
        set_points = self.set_points.any() and not recorded
        if self.config.large_scale == "drawn" or (set_points and self.set_points.all()):
            return Scenario(initial_state, plant.draw_exogenous(count, self.generator))
        mix = self.config.large_scale == "mixed"
        exogenous = sample_experience(self.processes, count, self.generator, mix=mix)
        if set_points:
            drawn = plant.draw_exogenous(count, self.generator)[:, : exogenous.shape[1], : exogenous.shape[2]]
            exogenous = torch.where(self.set_points, drawn, exogenous)
        return Scenario(initial_state, plant.with_previews(exogenous))

    @torch.no_grad()
    def cost(self, policy: nn.Module, episodes: Scenario, deviation: Actions | None = None) -> float:
        """Mean J_a of a policy, to whose commands a deviation may be added; infinite if the twin diverges under it."""
        try:
            cost = self.twin.cost(policy, *episodes, deviation).item()
        except DivergenceError:
            return math.inf
        return cost if math.isfinite(cost) else math.inf

    def judge(self, policy: nn.Module, episodes: Scenario) -> tuple[float, float]:
        """The cost by which policies are compared, which counts failures in extreme episodes; and mean J_a.

        Extreme episodes begin with the extremes of each state, under the inputs of the others in turn. What they cost
        beyond ten times J_a counts as if one episode in a hundred were one. State feedback is asked for J_a alone,
        because model predictive control takes too long in further episodes.
        """
        cost = self.cost(policy, episodes)
        if not len(self.extremes) or isinstance(policy, StateFeedback):
            return cost, cost
        beyond = self.cost(policy, self._extreme(episodes)) - FAILURE * abs(cost)
        return cost + RARE * max(0.0, beyond) if math.isfinite(cost) else cost, cost

    def with_extremes(self, episodes: Scenario) -> Scenario:
        """Some episodes, and the extreme ones under their inputs, if there are some."""
        return both(episodes, self._extreme(episodes)) if len(self.extremes) else episodes

    def _extreme(self, episodes: Scenario) -> Scenario:
        order = torch.arange(len(self.extremes), device=self.extremes.device) % len(episodes.exogenous)
        return Scenario(self.extremes, episodes.exogenous[order])

    def state_dict(self) -> dict[str, Any]:
        processes = [{"mean": process.mean, "covariance": process.covariance} for process in self.processes]
        return {"processes": processes, "recorded": self.recorded}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        signals = self.twin.plant.acting_inputs
        self.processes.clear()
        self.processes.extend(ExogenousProcess(**saved, signals=signals) for saved in state["processes"])
        self.recorded = state["recorded"]


def both(episodes: Scenario, others: Scenario) -> Scenario:
    """Some episodes, and others."""
    return Scenario(*(torch.cat(pair) for pair in zip(episodes, others, strict=True)))


class FitInputs(Step):
    """Step 3: fit a Gaussian process to the exogenous input of the episode, if its record is whole.

    Reads ``record``. Writes ``large_scale``, the large scale d̃ of the inputs that act, n × n_z, of the last process.

    Args:
        virtual: virtual episodes, which keep the processes.
    """

    in_keys = ["record"]
    out_keys = ["large_scale"]

    def __init__(self, virtual: VirtualEpisodes):
        super().__init__(virtual=virtual)
        self.virtual = virtual

    def forward(self, episode: TensorDictBase) -> TensorDictBase:
        if episode["record", "whole"]:
            self.virtual.learn(record_of(episode))
        return episode.set("large_scale", self.virtual.processes[-1].mean)
