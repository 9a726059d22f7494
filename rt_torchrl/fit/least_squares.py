r"""The least-squares fit of a twin: weights, initial states, biases and noise levels by maximum likelihood.

The descent over all unknowns and the levels take turns, until the levels rest:

.. math:: \sigma_j^2 = \frac{\sum_kr_{kj}^2}{N_j\,(1 - p/N)}

with N_j samples of sensor j out of N, and p unknowns that the data determine. Step 4 of a training takes the same
residuals, with the known noise of :func:`rt_torchrl.fit.sensors.state_sensors`.

Over a whole record of an unstable system the twin explodes whatever its weights are, and J prefers wrong ones. Records
are then cut into segments with first states of their own (multiple shooting), whose length the data choose.
"""

import contextlib
import copy
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.fit.likelihood import Likelihood, WeightPrior, first_noise
from rt_torchrl.fit.sensors import Sensor, SensorRecord, scatter_of, segments
from rt_torchrl.fit.uncertainty import Errors, Uncertainty, inverse_information, named_values
from rt_torchrl.optimisers.descent import Descended
from rt_torchrl.optimisers.levenberg_marquardt import LevenbergMarquardt
from rt_torchrl.options import AtLeastOne, Count, NotNegative, configuration
from rt_torchrl.plants.signal import differences
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.twin import DigitalTwin

NOISE_TOLERANCE = 1e-8
"""A descent ends where a step promises to lower J by less than this share. One standard error of a weight changes J by
about one part in the number of samples, so the default for noise-free records would end too early."""
INITIAL_ITERATIONS = 20
"""Number of trial steps for initial states alone; it is small because J is nearly quadratic in them."""
SETTLED = 0.01
"""Relative change of the noise levels below which they rest."""
LEAST_NOISE = 1e-9
"""Least noise level, as a share of its first guess; less is rounding."""
EXPLAINED = 0.5
"""RMS error of a sensor, as a share of the scatter of its readings, below which a twin explains them."""
SURE = 0.02
"""Share of these errors below which whole records are explained, even if the twin is unstable."""
SHORT = 60
"""Number of short segments of a record, which tell whether a twin is unstable."""
GROWTH = 1e3
"""Factor by which errors of first states grow along the records of a system that is called unstable."""
ALIKE = 0.5
"""Correlation of neighbouring residuals above which they are no noise."""
ROUNDED = 1e-5
"""RMS error of a sensor, as a share of the scatter of its readings, that is rounding, such as of single precision."""
DEPARTURE = 3.0
"""Ratio of RMS errors over longer and shorter segments above which the twin has left the longer ones."""
SHORTENED = 3
"""Factor from one length of segments to the next shorter one."""
MOST_UNKNOWNS = 1000
"""Greatest number of first states of segments; the normal equations hold its square."""


R = TypeVar("R")


def over_segments(
    closure: nn.Module,
    intervals: int,
    fit: Callable[[int], tuple[R, Tensor]],
    enough: Tensor,
    unstable: Callable[[], bool],
) -> R:
    """Fit whole records; those of an unstable twin over the longest segments that it follows as well as shorter ones.

    Where the errors over whole records are not small enough, or not tiny and the twin is unstable under the first
    weights, short segments are fitted from the same weights, and whole records again from what these tell; the better
    of the two fits of whole records stays. If the twin is stable under what short segments tell, it lacks something
    that no segment shows better, and whole records stay. Otherwise errors count as small enough where they are near
    those of short segments, and segments of a third of the records are fitted, then of a ninth, and so on, from the
    same weights or, where the twin diverges over whole records under these, from what the short ones tell.

    Args:
        closure: closure with the weights; those of the fit that is returned stay.
        intervals: number of control intervals of the longest record.
        fit: function of the number of control intervals of a segment, or 0 for whole records, that moves the weights
            and returns the result and its RMS errors; these are infinite, or it raises, where the twin diverges.
        enough: RMS errors that are small enough.
        unstable: whether the twin is unstable under the present weights; see :meth:`Estimation.unstable`.

    Raises:
        FloatingPointError: if every fit diverges.
    """
    start = copy.deepcopy(closure.state_dict())
    fits: dict[int, tuple[R, Tensor, dict[str, Tensor]]] = {}

    def explains(length: int, weights: dict[str, Tensor]) -> bool:
        closure.load_state_dict(weights)
        with contextlib.suppress(FloatingPointError):
            result, errors = fit(length)
            fits[length] = result, errors, copy.deepcopy(closure.state_dict())
            return bool((errors <= enough).all())
        return False

    def misfit(entry: tuple[R, Tensor, dict[str, Tensor]]) -> float:
        return (entry[1] / enough).square().mean().item()

    first, short, whole = start, max(intervals // SHORT, 2), explains(0, start)
    closure.load_state_dict(start)
    if short < intervals and (not whole or ((fits[0][1] > SURE * enough).any() and unstable())):
        before = fits.pop(0, None)
        while short < intervals and not fits:  # the shortest segments may have too many first states
            explains(short, start)
            short *= SHORTENED
        if fits:
            _, (_, errors, weights) = fits.popitem()
            closure.load_state_dict(weights)  # whole records bend the weights until nothing grows
            grows = unstable()
            enough = torch.minimum(enough, DEPARTURE * errors) if grows else enough
            whole = explains(0, weights) or (0 in fits and not grows)
            if before is None or not before[1].isfinite().all():
                first = weights
        if before is not None and (0 not in fits or misfit(before) <= misfit(fits[0])):
            fits[0] = before
    length = 0
    while not whole and length != 1:
        length = max((length or intervals) // SHORTENED, 1)
        whole = explains(length, first)
    if not fits:
        closure.load_state_dict(start)
        return fit(0)[0]  # which says why it fails
    least = torch.stack([errors for _, errors, _ in fits.values()]).amin(0)
    follow = [entry for entry in fits.values() if (entry[1] <= DEPARTURE * least).all()]
    # The errors of no length are least for all sensors, if those of some grow where those of others fall.
    result, _, weights = follow[0] if follow else min(fits.values(), key=misfit)
    closure.load_state_dict(weights)
    return result


@torch.no_grad()
def move(closure: nn.Module, generator: torch.Generator) -> None:
    """Move the weights at random, each by a normal number of some units; a unit is a factor of e for a logarithm."""
    far = 3.0 * torch.rand(1, generator=generator, dtype=torch.float64).item()
    for w in closure.parameters():
        if w.requires_grad:
            w.add_(far * torch.randn(w.shape, generator=generator, dtype=torch.float64).to(w.device))


@configuration
class EstimationConfig:
    """Parameters of an estimation.

    Args:
        iterations: trial steps of each descent.
        rounds: greatest number of rounds in which noise levels follow the residuals.
        prior: stiffness Λ of the weights of the closure's perceptrons. Other weights have no prior.
        starts: number of first weights that the descent begins with. Beside the present ones these are the present ones
            and the best ones so far in turns, moved at random: one sensor may leave several local minima.
        errors: formula of the standard errors: ``fisher`` for white noise, or ``robust`` for residuals with memory.
        segment: number of control intervals of the segments that records are cut into, each with a first state of its
            own (multiple shooting); 0 for whole records. None lets the data choose: whole records, unless the twin
            leaves them where it follows shorter segments, as it does with an unstable system; then the longest segments
            that it follows as well as the shortest ones.
    """

    iterations: AtLeastOne = 30
    rounds: AtLeastOne = 10
    prior: NotNegative = 0.0
    starts: AtLeastOne = 1
    errors: Errors = "fisher"
    segment: Count | None = None


class Estimate(NamedTuple):
    """Result of an estimation; the closure itself is trained in place.

    Args:
        before, after: named values of the closure.
        noise: noise level of each sensor, by name, in its unit.
        biases: bias of each sensor, by name; zero for one without.
        initial: initial states of the records.
        likelihood: the likelihood at its minimum.
        uncertainty: standard errors, intervals and warnings.
        iterations: number of trial steps.
        segment: number of control intervals of the segments that the records were cut into; 0 for whole records.
    """

    before: dict[str, float]
    after: dict[str, float]
    noise: dict[str, float]
    biases: dict[str, float]
    initial: Float[Tensor, "records n_s"]
    likelihood: Likelihood
    uncertainty: Uncertainty
    iterations: int
    segment: int = 0

    def warnings(self) -> list[str]:
        """What a user must know before using the estimate, in plain words; empty if there is nothing."""
        warnings = []
        if self.segment:
            warnings.append(
                f"the twin was fitted over segments of {self.segment} control intervals "
                f"({self.segment * self.likelihood.plant.dt:g} s) with first states of their own, as all errors here "
                "are; over whole records it may leave what was read"
            )
        rms, scatter = judged(self.likelihood).rms, scatter_of(self.likelihood.sensors, self.likelihood.records)
        for sensor, error, size in zip(self.likelihood.sensors, rms.tolist(), scatter.tolist(), strict=True):
            if error > EXPLAINED * size > 0.0:
                warnings.append(
                    f"the twin does not explain {sensor.name}: its RMS error is {error:.3g} {sensor.measurement.unit}, "
                    f"the readings scatter by {size:.3g}; check columns, units, inputs and plant, then raise starts"
                )
        if words := not_white(self.likelihood):
            warnings.append(words)
        return warnings + self.uncertainty.warnings()


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
        config: parameters of the estimation.
    """

    def __init__(
        self,
        twin: DigitalTwin,
        sensors: Sequence[Sensor],
        *,
        spread: Float[Tensor, " n_s"] | None = None,
        config: EstimationConfig | None = None,
    ):
        self.twin, self.sensors, self.config = twin, tuple(sensors), config or EstimationConfig()
        unknown = torch.full((len(twin.plant.states),), math.inf, dtype=torch.float64, device="cpu")  # moved to records
        self.spread = unknown if spread is None else spread
        names = ", ".join(state.name for state in twin.plant.states)
        if self.spread.shape != unknown.shape or not (self.spread >= 0.0).all():
            raise ValueError(
                f"spread={self.spread.tolist()} of the initial states must hold one number for each of {names}: 0 for "
                "a state that is known, or inf."
            )
        self.likelihood = functools.partial(Likelihood, twin, self.sensors, self.spread)

    def run(self, records: Sequence[SensorRecord]) -> Estimate:
        """Estimate all unknowns from the records.

        Raises:
            ValueError: if there is no record, or a sensor has no sample.
            DivergenceError: if the twin diverges under the weights that it starts from.
            FloatingPointError: if so many unknowns fit all samples that these tell no noise level.
        """
        closure = self.twin.closure
        before = {name: value.item() for name, value in named_values(closure).items()}
        prior = WeightPrior(closure, self.config.prior) if self.config.prior else None
        if self.config.segment is None and all(r.course is not None for r in records):
            likelihood, iterations, segment = self._longest(records, prior)
        else:
            segment = self.config.segment or 0
            likelihood, iterations = self._minimum(records, segment, prior)
        names = [sensor.name for sensor in self.sensors]
        return Estimate(
            before,
            {name: value.item() for name, value in named_values(closure).items()},
            dict(zip(names, likelihood.noise.tolist(), strict=True)),
            dict(zip(names, likelihood.biases().tolist(), strict=True)),
            likelihood.initial().detach(),
            likelihood,
            Uncertainty(likelihood, errors=self.config.errors),
            iterations,
            segment,
        )

    def _minimum(
        self, records: Sequence[SensorRecord], length: int, prior: WeightPrior | None
    ) -> tuple[Likelihood, int]:
        """Fit records, or segments of a length, from several first weights, with the noise levels that they leave.

        It returns the likelihood at its minimum, and the number of trial steps.

        The first two descents begin with the present weights. The others begin with these and with the best ones so far
        in turns, moved at random: the best may have run to where nothing shows them.
        """
        closure, config = self.twin.closure, self.config
        if length:
            records = [part for record in records for part in segments(record, length, self.twin.plant.dt)]
        generator, origin = torch.Generator().manual_seed(0), copy.deepcopy(closure.state_dict())
        least, weights, iterations = math.inf, origin, 0
        for number in range(1 + config.starts):
            closure.load_state_dict(weights if number > 1 and number % 2 else origin)
            if number > 1:
                move(closure, generator)
            try:
                if number:
                    iterations += self._descended(self.likelihood(records, prior=prior, known=True)).iterations
                likelihood = self.likelihood(records, prior=prior)
                descended = self._descended(likelihood)
            except FloatingPointError:
                if number:  # weights drawn at random may be nonsense
                    continue
                raise
            iterations += descended.iterations
            if not number or descended.best < least:
                least, best, weights = descended.best, likelihood, copy.deepcopy(closure.state_dict())
        closure.load_state_dict(weights)
        for _ in range(config.rounds):
            rest = self._follow_residuals(best)
            iterations += self._descended(best).iterations
            if rest:
                break
        return best, iterations

    def _longest(self, records: Sequence[SensorRecord], prior: WeightPrior | None) -> tuple[Likelihood, int, int]:
        """The fit over whole records, or over the longest segments that the twin follows as well as shorter ones.

        It returns what :meth:`_minimum` does, with the steps of all fits, and the length of the segments.
        """
        scatter = scatter_of(self.sensors, records)
        floor = scatter.new_tensor([DEPARTURE * (sensor.noise or 0.0) for sensor in self.sensors])
        lengths, steps = [len(record.actions) for record in records], 0
        free, samples = int((self.spread > 0.0).sum()), sum(int(record.seen.sum()) for record in records)

        def fit(length: int) -> tuple[tuple[Likelihood, int], Tensor]:
            nonlocal steps
            if length and free * sum(-(-n // length) for n in lengths) > min(MOST_UNKNOWNS, samples // 2):
                raise FloatingPointError(f"segments of {length} control intervals have too many first states")
            likelihood, iterations = self._minimum(records, length, prior)
            steps += iterations
            return (likelihood, length), judged(likelihood).rms

        enough = torch.maximum(EXPLAINED * scatter, floor)
        best, length = over_segments(self.twin.closure, max(lengths), fit, enough, lambda: self.unstable(records))
        return best, steps, length

    def unstable(self, records: Sequence[SensorRecord]) -> bool:
        """Whether an error grows by more than a factor of 1000 along a record.

        The product of the sensitivities of short segments tells it, which begin where the record is: a replay of the
        whole record would leave it, and may come to rest elsewhere. States are measured by their usual sizes, see
        :func:`usual_sizes`.
        """
        free, noise = Estimation(self.twin, self.sensors), first_noise(self.sensors, records)
        for record in records:
            parts = segments(record, max(len(record.actions) // SHORT, 2), self.twin.plant.dt)
            likelihood = free.likelihood(parts, noise, weights=False, biases=torch.zeros_like(noise))
            size, ends = likelihood.initial.unit.sum(-1), dict[int, Tensor]()
            try:
                for group in likelihood.groups:
                    ends.update(zip(group.numbers, likelihood.replay(group)[1][:, -1] / size[:, None], strict=True))
            except DivergenceError:
                return True
            growth = torch.eye(len(size), dtype=size.dtype, device=size.device)
            for number in range(len(parts)):
                growth = ends[number] @ growth
                if not growth.abs().max() < GROWTH:
                    return True
        return False

    def fit_initial_states(
        self, records: Sequence[SensorRecord], noise: Float[Tensor, " n_y"], biases: Float[Tensor, " n_y"] | None = None
    ) -> Likelihood:
        """The likelihood of other records under the present weights, at the initial states that suit them best.

        Args:
            records: the records.
            noise: noise levels.
            biases: biases of the sensors; None for none.
        """
        biases = torch.zeros_like(noise) if biases is None else biases
        likelihood = self.likelihood(records, noise, weights=False, biases=biases)
        method = LevenbergMarquardt(likelihood.unknowns, tolerance=NOISE_TOLERANCE)
        method.run(likelihood.normal_equations, INITIAL_ITERATIONS)
        return likelihood

    def _descended(self, likelihood: Likelihood) -> Descended:
        optimiser = LevenbergMarquardt(likelihood.unknowns, tolerance=NOISE_TOLERANCE)
        return optimiser.run(likelihood.normal_equations, self.config.iterations)

    def _follow_residuals(self, likelihood: Likelihood) -> bool:
        """Set noise levels by the residuals; whether they rest."""
        blocks = likelihood.residuals()
        equations = likelihood.normal_equations(blocks)
        if not equations.matrix.isfinite().all():
            raise FloatingPointError("the derivatives of finite states overflow")
        inverse = inverse_information(equations.matrix)
        by_priors = float((likelihood.priors()[0] * inverse.matrix.diagonal()).sum())
        determined = inverse.root.shape[1] - by_priors  # by samples
        given = torch.tensor([sensor.noise is not None for sensor in self.sensors], device=likelihood.noise.device)
        squares = torch.stack([block.values.square().sum((0, 1)) for block in blocks]).sum(0)
        total = int(likelihood.samples.sum())
        if determined > total - 0.5 and not given.all():
            raise FloatingPointError(
                f"{total} samples determine {determined:.0f} unknowns and no level of the noise: measure more, fit "
                "longer segments, or give every Sensor its noise"
            )
        freedom = likelihood.samples * (1.0 - determined / total)
        floor = LEAST_NOISE * first_noise(self.sensors, likelihood.records)
        levels = torch.maximum(likelihood.noise * (squares / freedom).sqrt(), floor)
        levels = torch.where(given, likelihood.noise, levels)
        rest = bool(((levels / likelihood.noise).log().abs() < SETTLED).all())
        likelihood.noise = levels
        return rest


class Judgement(NamedTuple):
    """Result of a twin on records: RMS errors of the sensors, the readings that it replays, and the records."""

    rms: Float[Tensor, " n_y"]
    readings: list[Tensor]
    records: list[SensorRecord]


class Identified(NamedTuple):
    """Result of an identification: the estimate, and how well the twin replays both kinds of records.

    Where the estimate is over segments, so are the errors.
    """

    estimate: Estimate
    training: Judgement
    held_out: Judgement


def identify(estimation: Estimation, training: Sequence[SensorRecord], held_out: Sequence[SensorRecord]) -> Identified:
    """Estimate on some records and judge on both kinds, each with the initial states that suit it best.

    Raises:
        ValueError: if a sensor has no sample in the training records.
        DivergenceError: if the twin diverges under the weights that it starts from.
    """
    estimate = estimation.run(training)
    if estimate.segment:
        dt = estimation.twin.plant.dt
        held_out = [part for record in held_out for part in segments(record, estimate.segment, dt)]
    likelihood = estimate.likelihood
    other = estimation.fit_initial_states(held_out, likelihood.noise, likelihood.biases().detach())
    return Identified(estimate, judged(likelihood), judged(other))


def judged(likelihood: Likelihood) -> Judgement:
    """The twin's errors in the samples that exist; infinite, and its readings unknown, if it diverges."""
    records, signals = likelihood.records, [sensor.measurement for sensor in likelihood.sensors]
    measured = torch.cat([record.readings for record in records])
    try:
        readings = likelihood.simulated()
    except DivergenceError:
        unknown = [record.readings * torch.nan for record in records]
        return Judgement(torch.full_like(likelihood.noise, torch.inf), unknown, records)
    return Judgement(differences(signals, torch.cat(readings), measured).square().nanmean(0).sqrt(), readings, records)


def autocorrelation(likelihood: Likelihood) -> Float[Tensor, " n_y"]:
    """Correlation of the residuals of neighbouring samples that exist, for each sensor."""
    products, squares = _sums(likelihood)
    return products / squares


def _sums(likelihood: Likelihood) -> tuple[Float[Tensor, " n_y"], Float[Tensor, " n_y"]]:
    """Sums of the products of neighbouring residuals, in units of the noise, and of their squares."""
    products, squares = torch.zeros_like(likelihood.noise), torch.zeros_like(likelihood.noise)
    for block in likelihood.residuals():
        for values, seen in zip(block.values, block.group.seen, strict=True):
            for k in range(len(products)):
                r = values[seen[:, k], k]
                products[k] += r[1:] @ r[:-1]
                squares[k] += r @ r
    return products, squares


def not_white(likelihood: Likelihood) -> str:
    """What residuals that are no noise say of the standard errors; empty where neighbours are hardly alike."""
    (products, squares), scatter = _sums(likelihood), scatter_of(likelihood.sensors, likelihood.records)
    rms = likelihood.noise * (squares / likelihood.samples).sqrt()
    columns = ((products / squares).tolist(), rms.tolist(), scatter.tolist())
    alike = ", ".join(
        f"{sensor.name} (correlation {value:.2g}, RMS {error:.2g} {sensor.measurement.unit})"
        for sensor, value, error, size in zip(likelihood.sensors, *columns, strict=True)
        if value > ALIKE and error > ROUNDED * size
    )
    words = (
        f"neighbouring residuals of {alike} are alike: noise drives the system, which robust standard errors hold, or "
        "the twin lacks something, steps or reads too coarsely, which no standard errors hold"
    )
    return words if alike else ""
