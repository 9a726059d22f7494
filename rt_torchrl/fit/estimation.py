r"""Identification from what sensors read: weights, initial states, biases and noise levels by maximum likelihood.

The descent over all unknowns and the levels take turns, until the levels rest:

.. math::
    \sigma_j^2 = \frac{\sum_kr_{kj}^2}{N_j\,(1 - p/N)}, \qquad \Lambda = \frac{\gamma}{\|w - w^0\|^2}, \qquad
    \gamma = \sum_i\big(1 - \Lambda H^{-1}_{ii}\big)

with N_j samples of sensor j out of N, p unknowns that the data determine, and γ of them among the weights of
perceptrons (MacKay, Neural Computation 4 (1992) 415).
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.fit.covariance import inverse_information, named_values
from rt_torchrl.fit.first_values import first_noise, move, state_sizes
from rt_torchrl.fit.likelihood import Biases, Likelihood
from rt_torchrl.fit.output_error import INITIAL_ITERATIONS, NOISE_TOLERANCE, InitialStates
from rt_torchrl.fit.sensor_record import SensorRecord
from rt_torchrl.fit.sensors import Sensor
from rt_torchrl.fit.uncertainty import Errors, Uncertainty
from rt_torchrl.fit.weight_prior import BeliefPrior, WeightPrior
from rt_torchrl.optimisers.levenberg_marquardt import LevenbergMarquardt
from rt_torchrl.options import check_options
from rt_torchrl.trajectories.twin import DigitalTwin

SETTLED = 0.01
"""Relative change of the noise levels below which they rest."""
LEAST_NOISE = 1e-9
"""Least noise level, as a share of its first guess; less is rounding."""
STIFFNESS = (1e-6, 1e8)
"""Range of the prior's stiffness Λ where the data choose it."""


@dataclass(frozen=True, kw_only=True)
class EstimationConfig:
    """Parameters of an estimation.

    Args:
        iterations: trial steps of each descent.
        rounds: greatest number of rounds in which noise levels and prior follow the residuals.
        prior: stiffness Λ of the weights of the closure's perceptrons; None lets the data choose it. Other weights
            have no prior.
        starts: number of first weights that the descent begins with. Beside the present ones these are the present ones
            and the best ones so far in turns, moved at random: one sensor may leave several local minima.
        errors: formula of the standard errors: ``fisher`` for white noise, or ``robust`` for residuals with memory.
    """

    iterations: int = 30
    rounds: int = 10
    prior: float | None = 0.0
    starts: int = 1
    errors: Errors = "fisher"

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("iterations", "rounds", "starts"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} of the estimation must be at least 1.")
        if self.prior is not None and not self.prior >= 0.0:
            raise ValueError(f"prior={self.prior} of the estimation must not be negative; None lets the data choose.")


class Estimate(NamedTuple):
    """Result of an estimation; the closure itself is trained in place.

    Args:
        before, after: named values of the closure.
        noise: noise level of each sensor, by name, in its unit.
        biases: bias of each sensor, by name; zero for one without.
        initial: initial states of the records.
        stiffness: stiffness Λ of the prior.
        likelihood: the likelihood at its minimum.
        uncertainty: standard errors, intervals and warnings.
        iterations: number of trial steps.
    """

    before: dict[str, float]
    after: dict[str, float]
    noise: dict[str, float]
    biases: dict[str, float]
    initial: Float[Tensor, "records n_s"]
    stiffness: float
    likelihood: Likelihood
    uncertainty: Uncertainty
    iterations: int


class Estimation:
    """Estimates a twin's closure from what sensors read.

    The descent is taken in two ways: over all unknowns together, and over the weights alone before all unknowns. The
    lower cost stays. The first way can make up for wrong weights by initial states; the second can drive weights away
    to make up for wrong initial states.

    Args:
        twin: the twin, whose closure is trained in place.
        sensors: the sensors of all records.
        spread: standard deviation of the initial states about their guess: zero for a state that is known, infinite for
            one of which only the readings tell. None lets all be unknown.
        process: standard deviation of what process noise does to every state from a record to one that follows it, see
            :func:`chained`; None if there is none. No state is known then, so that no ``spread`` may be zero.
        config: parameters of the estimation.
    """

    def __init__(
        self,
        twin: DigitalTwin,
        sensors: Sequence[Sensor],
        *,
        spread: Float[Tensor, " n_s"] | None = None,
        process: Float[Tensor, " n_s"] | None = None,
        config: EstimationConfig | None = None,
    ):
        self.twin, self.sensors, self.config = twin, tuple(sensors), config or EstimationConfig()
        unknown = torch.full((len(twin.plant.states),), math.inf, dtype=torch.float64)
        self.spread = unknown if spread is None else spread
        if self.spread.shape != unknown.shape or not (self.spread >= 0.0).all():
            raise ValueError(
                f"spread={self.spread.tolist()} of the initial states must hold one number for each of "
                f"{', '.join(state.name for state in twin.plant.states)}: 0 for a state that is known, or inf."
            )
        self.process = process
        fits = process is None or (process.shape == unknown.shape and bool((process > 0.0).all()))
        if process is not None and not (fits and bool((self.spread > 0.0).all())):
            raise ValueError(
                f"process={process.tolist()} must hold a positive number for each of "
                f"{', '.join(state.name for state in twin.plant.states)}, and "
                f"no spread={self.spread.tolist()} may be zero beside it."
            )

    def run(self, records: Sequence[SensorRecord], belief: BeliefPrior | None = None) -> Estimate:
        """Estimate all unknowns from the records.

        Args:
            records: the records.
            belief: what was believed of the weights before; None for the prior of the configuration.

        Raises:
            ValueError: if there is no record, a sensor has no sample, or a record follows one without process noise.
            DivergenceError: if the twin diverges under the weights that it starts from.
        """
        closure = self.twin.closure
        before = {name: value.item() for name, value in named_values(closure).items()}
        self._require_process(records)
        stiffness = 1.0 if self.config.prior is None else self.config.prior
        prior = WeightPrior(closure, stiffness) if belief is None else belief
        likelihood, iterations = self._best_start(records, prior)
        for _ in range(self.config.rounds):
            rest = self._follow_residuals(likelihood)
            iterations += self._descend(likelihood)
            if rest:
                break
        names = [sensor.name for sensor in self.sensors]
        levels, biases = likelihood.noise.tolist(), likelihood.biases().tolist()
        return Estimate(
            before,
            {name: value.item() for name, value in named_values(closure).items()},
            dict(zip(names, levels, strict=True)),
            dict(zip(names, biases, strict=True)),
            likelihood.initial().detach(),
            prior.stiffness,
            likelihood,
            Uncertainty(likelihood, errors=self.config.errors),
            iterations,
        )

    def likelihood(
        self,
        records: Sequence[SensorRecord],
        noise: Float[Tensor, " n_y"] | None = None,
        *,
        prior: WeightPrior | None = None,
        weights: bool = True,
        known: bool = False,
    ) -> Likelihood:
        """The likelihood of records, with initial states at their guess.

        Args:
            records: the records.
            noise: noise levels; by default those that are given, and a share of the readings' scatter for others.
            prior: prior of the weights.
            weights: whether the weights are unknowns.
            known: whether to take the initial states as known.
        """
        noise = first_noise(self.sensors, records) if noise is None else noise
        first = self._guesses(records)
        free = [] if known else (self.spread > 0.0).nonzero().flatten().tolist()
        initial = InitialStates(first, free, state_sizes(self.twin.plant, first, self.sensors, records))
        biases = None if known else Biases(self.sensors, noise)
        return Likelihood(
            self.twin,
            records,
            self.sensors,
            initial,
            noise,
            spread=self.spread,
            process=None if known else self.process,
            biases=biases,
            prior=prior,
            weights=weights,
        )

    @torch.no_grad()
    def _guesses(self, records: Sequence[SensorRecord]) -> Float[Tensor, "records n_s"]:
        """First guesses of the initial states; a record that follows begins where the twin ends the one before."""
        found: list[Tensor] = []
        for number, record in enumerate(records):
            if record.follows and number:
                before = records[number - 1]
                given = (found[-1][None], before.exogenous[None], before.actions[None])
                found.append(self.twin.replay(*given, start=before.start).states[0, -1])
            else:
                found.append(record.guess)
        return torch.stack(found)

    def _require_process(self, records: Sequence[SensorRecord]) -> None:
        follows = [record.follows for record in records]
        if any(follows) and (self.process is None or follows[0]):
            raise ValueError(
                "a record follows the one before it: give the estimation its process noise, process=..., and begin "
                "with a record that follows nothing."
            )

    def fit_initial_states(self, records: Sequence[SensorRecord], noise: Float[Tensor, " n_y"]) -> Likelihood:
        """The likelihood of other records under the present weights, at the initial states that suit them best."""
        likelihood = self.likelihood(records, noise, weights=False)
        method = LevenbergMarquardt(likelihood.unknowns, tolerance=NOISE_TOLERANCE)
        method.run(likelihood.normal_equations, 2 * INITIAL_ITERATIONS)
        return likelihood

    def _best_start(self, records: Sequence[SensorRecord], prior: WeightPrior) -> tuple[Likelihood, int]:
        """The likelihood at its minimum under the first noise levels, by the best way."""
        closure, generator = self.twin.closure, torch.Generator().manual_seed(0)
        start = copy.deepcopy(closure.state_dict())
        best = self.likelihood(records, prior=prior)
        done = self._descend(best)
        cost, found = best.normal_equations().cost, copy.deepcopy(closure.state_dict())
        for number in range(self.config.starts):
            # In turns from the best weights and from the first ones: the best may have run to where nothing shows them.
            closure.load_state_dict(start if number % 2 or not number else found)
            if number:
                move(closure, generator)
            try:
                if self.process is None:
                    done += self._descend(self.likelihood(records, prior=prior, known=True))
                other = self.likelihood(records, prior=prior)
                done += self._descend(other)
            except FloatingPointError:  # weights drawn at random may be nonsense
                continue
            if other.normal_equations().cost < cost:
                best, cost, found = other, other.normal_equations().cost, copy.deepcopy(closure.state_dict())
        closure.load_state_dict(found)
        return best, done

    def _descend(self, likelihood: Likelihood) -> int:
        optimiser = LevenbergMarquardt(likelihood.unknowns, tolerance=NOISE_TOLERANCE)
        return optimiser.run(likelihood.normal_equations, self.config.iterations).iterations

    def _follow_residuals(self, likelihood: Likelihood) -> bool:
        """Set noise levels and prior by the residuals; whether they rest."""
        blocks = likelihood.residuals()
        equations = likelihood.normal_equations(blocks)
        inverse = inverse_information(equations.matrix).matrix
        rest, n, prior = True, likelihood.weight_count, likelihood.prior
        determined = likelihood.count - likelihood.held_back(inverse)
        if self.config.prior is None and prior is not None and prior.held.any():
            gamma = (prior.held * (1.0 - prior.stiffness * inverse.diagonal()[:n])).sum()
            moved = (prior.held * (prior.weights() - prior.start).square()).sum()
            new = (gamma / moved.clamp_min(1e-300)).clamp(*STIFFNESS).item()
            rest = abs(math.log(new / prior.stiffness)) < SETTLED
            prior.stiffness = new
        given = torch.tensor([sensor.noise is not None for sensor in self.sensors], device=likelihood.noise.device)
        count = torch.stack([record.seen.sum(0) for record in likelihood.records]).sum(0)
        squares, total = torch.stack([block.values.square().sum(0) for block in blocks]).sum(0), int(count.sum())
        freedom = count * max(1.0 - determined / total, 1.0 / total)
        floor = LEAST_NOISE * first_noise(self.sensors, likelihood.records)
        levels = torch.maximum(likelihood.noise * (squares / freedom).sqrt(), floor)
        levels = torch.where(given, likelihood.noise, levels)
        rest &= bool(((levels / likelihood.noise).log().abs() < SETTLED).all())
        likelihood.noise = levels
        return rest
