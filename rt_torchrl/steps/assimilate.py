"""Step 4: the closure is trained until the twin replays the record, or what some sensors have read of it."""

import contextlib
import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

from rt_torchrl.fit.least_squares import (
    EXPLAINED,
    NOISE_TOLERANCE,
    Estimate,
    Estimation,
    EstimationConfig,
    judged,
    multi_start,
    over_segments,
    scatter_of,
)
from rt_torchrl.fit.likelihood import Likelihood, WeightPrior
from rt_torchrl.fit.sensors import (
    Sensor,
    SensorRecord,
    sensor_records,
    sensors_of,
    state_places,
    state_sensors,
    with_biases,
)
from rt_torchrl.fit.uncertainty import Uncertainty
from rt_torchrl.optimisers.descent import Descended, Descent, DescentConfig
from rt_torchrl.optimisers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import differences
from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import AssimilationConfig
from rt_torchrl.steps.inputs import ExogenousProcess
from rt_torchrl.steps.report import Step, findings, merged
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of, identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin

DAMPING = 1e-3
"""Damping μ of the first fit by Levenberg-Marquardt."""
STARTS = 10
"""Number of first weights in the first episode of a fit to sensors: one sensor may leave several local minima."""
ROUNDS = 4
"""Greatest number of rounds in which the noise levels follow the residuals, in an episode."""
DRAWS = 200
"""Number of initial states that a plant draws, to learn how hidden ones depend on those that are read."""


class Assimilation:
    r"""Minimises :math:`J_p = \mathbb E\int L_p(s, \check s)\,dt` over the closure's weights (paper, eq. J_p).

    The expectation is over the records in D_S and, for each record, over realisations of its exogenous process. The
    *stored* actions drive all of them.

    Note: the paper replays from the first reading of the sensors; ``initial="estimated"`` also finds the first state.

    Args:
        twin: twin whose closure is updated in place; afterwards the closure holds the best weights seen, w_p*.
        config: parameters of step 4.
    """

    def __init__(self, twin: DigitalTwin, config: AssimilationConfig):
        if (config.segment or 0) > twin.plant.n_steps:
            raise ValueError(
                f"segment={config.segment} of the assimilation exceeds the {twin.plant.n_steps} control intervals of "
                f"an episode of plant {twin.plant.name!r}; 0 replays whole records."
            )
        self.twin, self.config = twin, config
        lbfgs = DescentConfig(optimiser="lbfgs", rate=1.0)
        self.descent = Descent(twin.closure, lbfgs if config.method == "lbfgs" else DescentConfig())
        self.damping = DAMPING
        """Damping μ with which the next fit by Levenberg-Marquardt begins."""
        sensors = state_sensors(twin.plant)
        spread = torch.zeros(len(twin.plant.states), dtype=torch.float64)
        if config.initial == "estimated":
            spread[[k for k in state_places(twin.plant, sensors) if k is not None]] = math.inf
        self._problem = Estimation(twin, sensors, spread=spread)
        self.length = config.segment or 0
        """Number of control intervals of the segments of the last fit; 0 for whole records."""
        self._records: Sequence[Trajectory] = ()
        self.begin()

    def begin(self) -> None:
        """Take the present closure for the ``first`` one, to which a twin that diverges goes back.

        The prior holds perceptrons at its weights. A training that goes on from an earlier one begins with the closure
        of that, which is not yet known when this object is made.
        """
        self.first = copy.deepcopy(self.twin.closure.state_dict())
        device = next((x.device for x in self.twin.plant.buffers()), "cpu")
        self.prior = WeightPrior(self.twin.closure, self.config.prior, device=device)

    def update(
        self,
        records: Sequence[Trajectory],
        processes: Sequence[ExogenousProcess],
        count: int,
        generator: torch.Generator,
    ) -> Descended:
        """Take the gradient steps of one episode.

        Args:
            records: the records in D_S.
            processes: the exogenous process of each record.
            count: number N_z of realisations of each process.
            generator: source of the realisations.

        Returns:
            J_p before and after, without the prior, and the descent's gradient and iterations. J_p is the mean over
            the records, or over the segments that the fit uses.
            J_p before is infinite if the twin diverges on the records; the fit then begins anew from the first closure.
            Where the twin diverges under that, too, all are infinite, and the closure stays as it is.
        """
        self._records, whole = records, batch_of(records)
        if self.config.inputs == "realisations":
            sampled = torch.cat([process.sample(count, generator) for process in processes])
            rows = torch.arange(len(whole.states), device=sampled.device).repeat_interleave(count)
            whole = whole.rows(rows)._replace(exogenous=self.twin.plant.with_previews(sampled))
        if self.config.sensors or not self.config.iterations:
            return self._descend_anew(whole)
        if self.config.segment is None:
            return self._over_chosen_segments(whole)
        self.length = min(self.length, whole.actions.shape[1])
        return self._descend_anew(self.in_segments(whole))

    def in_segments(self, whole: Trajectory) -> Trajectory:
        """Records as the last fit replayed them: in segments, or whole."""
        return whole.segments(self.length, self.twin.plant.dt) if self.length else whole

    def _over_chosen_segments(self, whole: Trajectory) -> Descended:
        """Descend over whole records, or over segments if the twin is unstable and leaves these."""
        sensors, begun = self._problem.sensors, copy.deepcopy(self._progress())
        records, before = sensor_records(self.twin.plant, sensors, whole), dict[int, float]()

        def fit(length: int) -> tuple[tuple[Descended, int, dict[str, Any]], Tensor]:
            self._resume(copy.deepcopy(begun))
            self.length = min(length, whole.actions.shape[1])
            found = self._descend_anew(self.in_segments(whole))
            # The first fit of a length begins with the present closure.
            found = found._replace(start=before.setdefault(length, found.start))
            return (found, length, copy.deepcopy(self._progress())), self._rms(self.in_segments(whole))

        found, self.length, progress = over_segments(
            self.twin.closure,
            whole.actions.shape[1],
            fit,
            EXPLAINED * scatter_of(sensors, records),
            lambda: self._problem.unstable(records),
        )
        self._resume(progress)
        return found

    def _progress(self) -> dict[str, Any]:
        """What the next descent depends on, except the closure."""
        return {"descent": self.descent.state_dict(), "damping": self.damping}

    def _resume(self, progress: dict[str, Any]) -> None:
        self.descent.load_state_dict(progress["descent"])
        self.damping = progress["damping"]

    def _descend_anew(self, replayed: Trajectory) -> Descended:
        """Descend from the present closure, or from the first one if the twin diverges under the present one.

        A twin without the dynamics of the real system bends its closure to the records, and the next record may lead to
        where the bent closure makes no sense. One that makes none of the first closure either keeps what it has.
        """
        present = copy.deepcopy(self.twin.closure.state_dict())
        with contextlib.suppress(FloatingPointError):
            return self._descend(replayed)
        self.descent.restart()
        self.twin.closure.load_state_dict(self.first)
        with contextlib.suppress(FloatingPointError):
            return self._descend(replayed)._replace(start=math.inf)
        self.twin.closure.load_state_dict(present)
        return Descended(math.inf, math.inf, math.inf, self.config.iterations)

    def _descend(self, replayed: Trajectory) -> Descended:
        config = self.config
        prior = self.prior.cost if self.prior.stiffness else lambda: replayed.states.new_zeros(())
        before = prior().item()
        if config.method == "levenberg_marquardt":
            found = self._least_squares(replayed)
        else:
            found = self.descent.run(
                lambda: self._identification_cost(replayed) + prior(),
                config.iterations,
                stop_below=config.stop_below,
            )
        if math.isinf(found.start):
            raise FloatingPointError("J_p of finite states overflows")
        return found._replace(start=found.start - before, best=found.best - prior().item())

    def _least_squares(self, replayed: Trajectory) -> Descended:
        """Descend by Levenberg-Marquardt from each of the first weights; the best weights stay."""
        config, tolerance = self.config, 1e-4 if self.config.initial == "measured" else NOISE_TOLERANCE

        def descend(number: int) -> Descended:
            likelihood = self.likelihood(replayed, prior=self.prior)
            method = LevenbergMarquardt(
                likelihood.unknowns, damping=DAMPING if number else self.damping, tolerance=tolerance
            )
            found = method.run(likelihood.normal_equations, config.iterations, stop_below=config.stop_below)
            if not number:
                self.damping = method.damping
            return found

        found = multi_start(self.twin.closure, config.starts, descend, first=self.first)
        return found[0]._replace(best=min((one.best for one in found), default=math.nan))

    def _identification_cost(self, replayed: Trajectory) -> Tensor:
        return identification_cost(self.twin.plant, self._flown(replayed), replayed.states, replayed.seen).mean()

    def _flown(self, replayed: Trajectory) -> Trajectory:
        states, actions, exogenous, start, _ = replayed
        return self.twin.replay(states[:, 0], exogenous, actions, start=start)

    @torch.no_grad()
    def cost_of(self, whole: Trajectory) -> float:
        """J_p of whole records under the present closure, without the prior; infinite if the twin diverges on them."""
        with contextlib.suppress(FloatingPointError):
            if self.config.initial == "measured":
                return self._identification_cost(whole).item()
            return self._problem.fit_initial_states(*self._compared(whole)).normal_equations().cost.item()
        return math.inf

    def likelihood(self, replayed: Trajectory, *, prior: WeightPrior | None = None) -> Likelihood:
        """The likelihood whose J is the mean J_p of records; their first states are unknowns if these are estimated.

        Args:
            replayed: records of equal length, as one batch.
            prior: prior of the closure's weights.
        """
        return self._problem.likelihood(*self._compared(replayed), prior=prior)

    def _compared(self, replayed: Trajectory) -> tuple[list[SensorRecord], Tensor]:
        """What J_p compares of records, and the noise with which the likelihood is the mean over them."""
        sensors, count = self._problem.sensors, len(replayed.states)
        noise = replayed.states.new_tensor([math.sqrt(count) * (sensor.noise or 1.0) for sensor in sensors])
        records = sensor_records(self.twin.plant, sensors, replayed)
        if self.config.initial == "measured":  # no error is seen where a replay begins
            for record in records:
                record.readings[0] = math.nan
        return records, noise

    @torch.no_grad()
    def _rms(self, replayed: Trajectory) -> Float[Tensor, " n_y"]:
        """RMS error of every state that J_p compares; infinite if the twin diverges."""
        try:
            if self.config.initial == "estimated":
                return judged(self._problem.fit_initial_states(*self._compared(replayed))).rms
            flown = self._flown(replayed)
        except FloatingPointError:
            return replayed.states.new_full((len(self._problem.sensors),), math.inf)
        plant = self.twin.plant
        places = [k for k, scale in enumerate(plant.discrepancy_scales) if scale < math.inf]
        signals = [plant.states[k] for k in places]
        errors = differences(signals, flown.states[..., places], replayed.states[..., places])
        errors[:, 0] = math.nan  # no error is seen where a replay begins
        if replayed.seen is not None:
            errors = torch.where(replayed.seen.unsqueeze(-1), errors, math.nan)
        return errors.flatten(0, 1).square().nanmean(0).sqrt()

    def explain(self, difference: float, generator: torch.Generator) -> bool:
        """Seek in the records of the last update why real episodes cost other than the twin says.

        Returns:
            Whether the twin has changed; a twin alone has nothing to try.
        """
        return False

    def report(self) -> Mapping[str, float | str]:
        """What the last update has found beside J_p: ``rms/STATE [UNIT]`` of :meth:`rms_errors`."""
        return {f"rms/{name}": error for name, error in self.rms_errors(self._records).items()}

    def rms_errors(self, records: Sequence[Trajectory]) -> dict[str, float]:
        """RMS error of every state that J_p compares, by ``STATE [UNIT]``, over the segments that the last fit used.

        The twin replays the measured inputs; an error is infinite where it diverges.
        """
        if not records:
            return {}
        signals = [sensor.measurement for sensor in self._problem.sensors]
        errors = self._rms(self.in_segments(batch_of(records))).tolist()
        return {f"{signal.name} [{signal.unit}]": error for signal, error in zip(signals, errors, strict=True)}

    def standard_errors(self, records: Sequence[Trajectory]) -> dict[str, float]:
        """Robust standard errors of the closure's named coefficients; none where the twin diverges or names nothing.

        The residuals over the segments that the last fit used tell the noise; see
        :class:`rt_torchrl.fit.uncertainty.Uncertainty`.
        """
        if not records or not hasattr(self.twin.closure, "named_coefficients"):
            return {}
        replayed = self.in_segments(batch_of(records))
        read, noise = self._compared(replayed)
        noise = torch.maximum(self._rms(replayed), 1e-9 * noise)
        with contextlib.suppress(FloatingPointError):
            likelihood = self._problem.likelihood(read, noise)
            if self.config.initial == "estimated":
                likelihood.initial.load_state_dict(self._problem.fit_initial_states(read, noise).initial.state_dict())
            return Uncertainty(likelihood, errors="robust").standard_errors()
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next update depends on, except the closure."""
        return self._progress() | {"first": self.first, "length": self.length}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._resume(state)
        self.length = state["length"]
        closure = self.twin.closure
        present = copy.deepcopy(closure.state_dict())
        closure.load_state_dict(state["first"])
        self.begin()
        closure.load_state_dict(present)


class SensorAssimilation(Assimilation):
    """Estimates weights, first states and noise levels from some sensors; of records it uses nothing else.

    Args:
        twin: twin whose closure is updated in place.
        config: parameters of step 4, with ``sensors``.

    Raises:
        ValueError: if the plant has no such state or measurement.
    """

    def __init__(self, twin: DigitalTwin, config: AssimilationConfig):
        super().__init__(twin, config)
        self.sensors = with_biases(sensors_of(twin.plant, config.sensors), config.biased)
        self.estimate: Estimate | None = None
        self.begun = False

    def _descend(self, replayed: Trajectory) -> Descended:
        config, first = self.config, FirstStates(self.twin.plant, self.sensors)
        if not config.iterations:
            return Descended(math.nan, math.nan, math.nan, 0)
        records = sensor_records(self.twin.plant, self.sensors, replayed)
        records = [record._replace(guess=first.guess(record), course=None) for record in records]
        starts = 1 if self.begun else STARTS
        options = EstimationConfig(iterations=config.iterations, rounds=ROUNDS, prior=config.prior, starts=starts)
        estimation = Estimation(self.twin, self.sensors, spread=first.spread, config=options)
        start = [w.detach().clone() for w in self.twin.closure.parameters()]
        self.estimate, self.begun = estimation.run(records), True
        found = [w.detach().clone() for w in self.twin.closure.parameters()]
        noise, samples = self.estimate.likelihood.noise, sum(int(record.seen.sum()) for record in records)
        costs = [self._misfit(estimation, records, noise, weights) for weights in (start, found)]
        before, after = (found.cost.item() / samples for found in costs)
        return Descended(before, after, costs[0].gradient.norm().item(), self.estimate.iterations)

    @torch.no_grad()
    def _misfit(
        self, estimation: Estimation, records: list[SensorRecord], noise: Float[Tensor, " n_y"], weights: list[Tensor]
    ) -> NormalEquations:
        """The likelihood's equations for these weights, at the first states that suit them best."""
        for held, value in zip(self.twin.closure.parameters(), weights, strict=True):
            held.copy_(value)
        return estimation.fit_initial_states(records, noise).normal_equations()

    def report(self) -> Mapping[str, float | str]:
        """RMS and standard errors, noise levels and biases of the last update, by name."""
        if self.estimate is None:
            return {}
        errors = self.standard_errors(self._records)
        found = {f"noise/{name}": value for name, value in self.estimate.noise.items()}
        found |= {f"bias/{name}": self.estimate.biases[name] for name in self.config.biased}
        return {**found, **{f"standard_error/{name}": value for name, value in errors.items()}, **super().report()}

    def rms_errors(self, records: Sequence[Trajectory]) -> dict[str, float]:
        """RMS error of what every sensor reads, in the records of the last update."""
        if self.estimate is None:
            return {}
        signals = [sensor.measurement for sensor in self.sensors]
        errors = judged(self.estimate.likelihood).rms.tolist()
        return {f"{signal.name} [{signal.unit}]": error for signal, error in zip(signals, errors, strict=True)}

    def standard_errors(self, records: Sequence[Trajectory]) -> dict[str, float]:
        """Standard errors of the last update."""
        return {} if self.estimate is None else self.estimate.uncertainty.standard_errors()

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"begun": self.begun}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.begun = state["begun"]


class FirstStates:
    r"""What the first state of an episode is, given the states that sensors read in its first sample.

    .. math:: \hat s = \bar s + C_{sy}C_{yy}^{-1}(y - \bar y)

    Mean and covariance are those of the initial states that the plant draws. A state that always begins with the same
    value, or follows from one that is read, is known.

    Args:
        plant: the plant.
        sensors: the sensors.

    Attributes:
        spread: standard deviation of the first state about that guess; infinite for states that are read.
    """

    def __init__(self, plant: Plant, sensors: tuple[Sensor, ...]):
        drawn = plant.draw_initial_state(DRAWS, torch.Generator().manual_seed(0))
        own = state_places(plant, sensors)
        self._columns = [column for column, k in enumerate(own) if k is not None]
        self._read = [k for k in own if k is not None]
        self._mean = drawn.mean(0)
        centred = drawn - self._mean
        self._gain = torch.linalg.pinv(centred[:, self._read]) @ centred
        left = centred - centred[:, self._read] @ self._gain
        scale = centred.abs().amax(0)
        deviation = left.square().mean(0).sqrt()
        self.spread = torch.where(deviation > 1e-9 * scale, deviation, 0.0)
        self.spread[self._read] = torch.inf

    def guess(self, record: SensorRecord) -> Float[Tensor, " n_s"]:
        """The guess of a record's first state."""
        first = record.readings[0, self._columns]
        first = torch.where(first.isnan(), self._mean[self._read], first)
        found = self._mean + (first - self._mean[self._read]) @ self._gain
        found[self._read] = first
        return found


class Assimilate(Step):
    """Step 4: descend J_p over the latest records, and explain what real episodes cost other than the twin says.

    Reads ``record`` and ``large_scale``, of which the memory D_S and the processes hold more. Writes ``J_p_before`` and
    ``J_p``, the cost of the twin on the records before and after.

    Args:
        assimilation: the fit of the twin.
        belief: what takes the twin's word for a policy, or not.
        short_term: memory D_S of the latest records.
        realisations: number N_z of draws of the inputs for each record.
        generator: source of the draws.
    """

    in_keys = ["record", "large_scale"]
    out_keys = ["J_p_before", "J_p"]

    def __init__(
        self,
        assimilation: Assimilation,
        belief: Belief,
        short_term: Sequence[Trajectory],
        realisations: int,
        generator: torch.Generator,
    ):
        super().__init__(assimilation=assimilation, belief=belief)
        self.assimilation, self.belief, self.short_term = assimilation, belief, short_term
        self.realisations, self.generator = realisations, generator
        self.closure_before: dict[str, Any] | None = None
        """State of the closure before the last fit, to which a twin that diverges goes back; None after that."""

    def forward(self, episode: TensorDictBase) -> TensorDictBase:
        report = self.fit(list(self.short_term))
        found = self.belief.examine()
        if self.assimilation.explain(self.belief.unexplained, self.generator):
            found = merged(findings(**self.assimilation.report()), self.belief.examine())
        return merged(merged(episode, report), found)

    def fit(self, records: Sequence[Trajectory]) -> TensorDictBase:
        """Fit the twin to records; the report of the fit."""
        latest, processes = self.belief.virtual.paired(records)
        self.closure_before = copy.deepcopy(self.belief.virtual.twin.closure.state_dict())
        found = self.assimilation.update(latest, processes, self.realisations, self.generator)
        fit = findings(J_p_before=found.start, J_p=found.best, closure_gradient=found.gradient, closure_refused=0.0)
        return merged(fit, findings(**self.assimilation.report()))
