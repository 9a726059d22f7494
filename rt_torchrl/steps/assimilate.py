"""Step 4: the closure is trained until the twin replays the record."""

import contextlib
import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

from rt_torchrl.fit.least_squares import (
    EXPLAINED,
    NOISE_TOLERANCE,
    SURE,
    Estimation,
    judged,
    over_segments,
)
from rt_torchrl.fit.likelihood import Likelihood, WeightPrior
from rt_torchrl.fit.sensors import SensorRecord, noise_levels, scatter_of, sensor_records, state_places, state_sensors
from rt_torchrl.fit.uncertainty import Uncertainty
from rt_torchrl.optimisers.descent import Descended, Descent, DescentConfig
from rt_torchrl.optimisers.levenberg_marquardt import LevenbergMarquardt
from rt_torchrl.plants.signal import differences
from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import ESTIMABLE, AssimilationConfig
from rt_torchrl.steps.report import Step, merged, metrics
from rt_torchrl.systems.operation import FIRST
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of, identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin

DAMPING = 1e-3
"""Damping μ of the first fit by Levenberg-Marquardt."""


class Assimilation:
    r"""Minimises :math:`J_p = \mathbb E\int L_p(s, \check s)\,dt` over the closure's weights (paper, eq. J_p).

    The expectation is over the records in D_S and, for each record, over realisations of its exogenous process. The
    *stored* actions drive all of them.

    Note: the paper replays from the first reading of the sensors; where these have noise, first states are found, too.

    Args:
        twin: twin whose closure is updated in place; afterwards the closure holds the best weights seen, w_p*.
        config: parameters of step 4.
    """

    def __init__(self, twin: DigitalTwin, config: AssimilationConfig):
        self.twin, self.config = twin, config
        lbfgs = DescentConfig(optimiser="lbfgs", rate=1.0)
        self.descent = Descent(twin.closure, lbfgs if config.method == "lbfgs" else DescentConfig())
        self.damping = DAMPING
        """Damping μ with which the next fit by Levenberg-Marquardt begins."""
        self._estimate_first_states(config.initial == "estimated")
        self.length = config.segment or 0
        """Number of control intervals of the segments of the last fit; 0 for whole records."""
        self._records: Sequence[Trajectory] = ()
        self.begin()

    def _estimate_first_states(self, estimates: bool) -> None:
        """Pose the problem with first states as unknowns beside the weights, or with those that were measured."""
        self.estimates, sensors = estimates, state_sensors(self.twin.plant)
        spread = torch.zeros(len(self.twin.plant.states), dtype=torch.float64)
        if estimates:
            spread[[k for k in state_places(self.twin.plant, sensors) if k is not None]] = math.inf
        self._problem = Estimation(self.twin, sensors, spread=spread)

    def begin(self) -> None:
        """Take the present closure for the ``first`` one, to which a twin that diverges goes back.

        The prior holds perceptrons at its weights. A training that goes on from an earlier one begins with the closure
        of that, which is not yet known when this object is made.
        """
        self.first = copy.deepcopy(self.twin.closure.state_dict())
        self.prior = WeightPrior(self.twin.closure, self.config.prior)

    def update(self, records: Sequence[Trajectory], draw: Callable[[], Trajectory] | None = None) -> Descended:
        """Take the gradient steps of one episode.

        Args:
            records: the records in D_S.
            draw: function that gives the records under realisations of their inputs; None for the measured inputs.

        Returns:
            J_p before and after, without the prior, and the descent's gradient and iterations. J_p is the mean over
            the records, or over the segments that the fit uses.
            J_p before is infinite if the twin diverges on the records; the fit then begins anew from the first closure.
            Where the twin diverges under that, too, all are infinite, and the closure stays as it is.
        """
        self._records, whole = records, batch_of(records) if draw is None else draw()
        if not self.config.iterations:
            return self._descend_anew(whole)
        before, damping = copy.deepcopy(self.twin.closure.state_dict()), self.damping
        descended, config = self._fit(whole), self.config
        asks = config.initial is None and not self.estimates and self._errs()
        if asks or self.estimates or self.twin.noise.any():
            self._find_noise()
        if asks and self.twin.noise.any() and (config.method, config.inputs) == ESTIMABLE:
            self._estimate_first_states(True)
            self.twin.closure.load_state_dict(before)
            self.damping = damping
            descended = self._fit(whole)
            self._find_noise()
        return descended

    def _errs(self) -> bool:
        """Whether the errors of the present twin are more than tiny."""
        sensors, whole = self._problem.sensors, batch_of(self._records)
        scatter = scatter_of(sensors, sensor_records(self.twin.plant, sensors, whole))
        return not (self._rms(self.in_segments(whole)) <= SURE * EXPLAINED * scatter).all()

    def _find_noise(self) -> None:
        """Give the twin the noise of the sensors that its records show; it keeps what it has where it diverges."""
        with contextlib.suppress(FloatingPointError):
            self.twin.noise = noise_levels(self.twin, self._records)

    def _fit(self, whole: Trajectory) -> Descended:
        """Descend over segments, or choose: whole records, or segments if the twin is unstable and leaves these."""
        if self.config.segment is not None:
            self.length = min(self.config.segment, whole.actions.shape[1])
            return self._descend_anew(self.in_segments(whole))
        sensors, damping = self._problem.sensors, self.damping
        records, before = sensor_records(self.twin.plant, sensors, whole), dict[int, float]()

        def fit(length: int) -> tuple[tuple[Descended, int, float], Tensor]:
            self.damping, self.length = damping, min(length, whole.actions.shape[1])
            descended = self._descend_anew(self.in_segments(whole))
            # The first fit of a length begins with the present closure.
            descended = descended._replace(start=before.setdefault(length, descended.start))
            return (descended, length, self.damping), self._rms(self.in_segments(whole))

        descended, self.length, self.damping = over_segments(
            self.twin.closure,
            whole.actions.shape[1],
            fit,
            EXPLAINED * scatter_of(sensors, records),
            lambda: self._problem.unstable(records),
        )
        return descended

    def in_segments(self, whole: Trajectory) -> Trajectory:
        """Records as the last fit replayed them: in segments, of shorter records in shorter ones, or whole."""
        length = min(self.length, whole.actions.shape[1])
        return whole.segments(length, self.twin.plant.dt) if length else whole

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
            likelihood = self.likelihood(replayed, prior=self.prior)
            tolerance = NOISE_TOLERANCE if self.estimates else 1e-4
            method = LevenbergMarquardt(likelihood.unknowns, damping=self.damping, tolerance=tolerance)
            descended = method.run(likelihood.normal_equations, config.iterations, stop_below=config.stop_below)
            self.damping = method.damping  # which goes on from episode to episode
        else:
            descended = self.descent.run(
                lambda: self._identification_cost(replayed) + prior(),
                config.iterations,
                stop_below=config.stop_below,
            )
        if math.isinf(descended.start):
            raise FloatingPointError("J_p of finite states overflows")
        return descended._replace(start=descended.start - before, best=descended.best - prior().item())

    def _identification_cost(self, replayed: Trajectory) -> Tensor:
        flown = self._flown(replayed)
        return identification_cost(self.twin.plant, flown, replayed.states, replayed.seen).mean()

    def _flown(self, replayed: Trajectory) -> Trajectory:
        states, actions, exogenous, start, seen, _ = replayed
        return self.twin.replay(states[:, 0], exogenous, actions, start=start)._replace(seen=seen)

    @torch.no_grad()
    def cost_of(self, whole: Trajectory) -> float:
        """J_p of whole records under the present closure, without the prior; infinite if the twin diverges on them."""
        with contextlib.suppress(FloatingPointError):
            if not self.estimates:
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
        if not self.estimates:  # no error is seen where a replay begins
            for record in records:
                record.readings[0] = math.nan
        return records, noise

    @torch.no_grad()
    def _rms(self, replayed: Trajectory) -> Float[Tensor, " n_y"]:
        """RMS error of every state that J_p compares; infinite if the twin diverges."""
        sensors, errors = self._problem.sensors, replayed.states.new_full((len(self._problem.sensors),), math.inf)
        with contextlib.suppress(FloatingPointError):
            if self.estimates:
                return judged(self._problem.fit_initial_states(*self._compared(replayed))).rms
            parts = (sensor_records(self.twin.plant, sensors, states) for states in (self._flown(replayed), replayed))
            flown, read = (torch.stack([record.readings for record in records]) for records in parts)
            read[:, 0] = math.nan  # no error is seen where a replay begins
            differing = differences([sensor.measurement for sensor in sensors], flown, read).flatten(0, 1)
            errors = differing.square().nanmean(0).sqrt()
        return errors

    def explain(self, difference: float) -> bool:
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

    def uncertainty(self, records: Sequence[Trajectory]) -> Uncertainty | None:
        """Robust standard errors of what the closure's weights give; None where the twin diverges, or trains nothing.

        The residuals over the segments that the last fit used tell the noise.
        """
        if not records or not any(weight.requires_grad for weight in self.twin.closure.parameters()):
            return None
        replayed = self.in_segments(batch_of(records))
        read, noise = self._compared(replayed)
        noise = torch.maximum(self._rms(replayed), 1e-9 * noise)
        with contextlib.suppress(FloatingPointError):
            likelihood = self._problem.likelihood(read, noise)
            if self.estimates:
                likelihood.initial.load_state_dict(self._problem.fit_initial_states(read, noise).initial.state_dict())
            return Uncertainty(likelihood, errors="robust")
        return None

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next update depends on, except the closure."""
        problem = {"first": self.first, "length": self.length, "estimates": self.estimates, "noise": self.twin.noise}
        return problem | {"descent": self.descent.state_dict(), "damping": self.damping}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.descent.load_state_dict(state["descent"])
        self.damping = state["damping"]
        self._estimate_first_states(state["estimates"])
        self.twin.noise = state["noise"]
        self.length = state["length"]
        closure = self.twin.closure
        present = copy.deepcopy(closure.state_dict())
        closure.load_state_dict(state["first"])
        self.begin()
        closure.load_state_dict(present)


class Assimilate(Step):
    """Step 4: descend J_p over the latest records, and explain what real episodes cost other than the twin says.

    Reads ``live``, ``record`` and ``large_scale``, of which the memory D_S and the processes hold more. Writes
    ``J_p_before`` and ``J_p``, the cost of the twin on the records before and after.

    Args:
        assimilation: the fit of the twin.
        belief: what takes the twin's word for a policy, or not.
        short_term: memory D_S of the latest records.
        realisations: number N_z of draws of the inputs for each record.
    """

    in_keys = ["record", "large_scale", "live"]
    out_keys = ["J_p_before", "J_p"]

    def __init__(
        self,
        assimilation: Assimilation,
        belief: Belief,
        short_term: Sequence[Trajectory],
        realisations: int,
    ):
        super().__init__(assimilation=assimilation)
        self.assimilation, self.belief, self.short_term = assimilation, belief, short_term
        self.realisations = realisations
        self.closure_before: dict[str, Any] | None = None
        """State of the closure before the last fit, to which a twin that diverges goes back; None after that."""

    def forward(self, episode: TensorDictBase) -> TensorDictBase:
        report = self.fit(list(self.short_term))
        if self.assimilation.explain(self.belief.unexplained):
            report.update(metrics(**self.assimilation.report()))
        # A part costs other than the episodes that the twin flies, and of the first controller it predicts nothing.
        if episode["record", "whole"] and episode["live"] != FIRST:
            report = merged(report, self.belief.examine())
        return merged(episode, report)

    def fit(self, records: Sequence[Trajectory]) -> TensorDictBase:
        """Fit the twin to records; the report of the fit."""
        virtual = self.belief.virtual
        (latest, processes), twin = virtual.paired(records), virtual.twin

        def draw() -> Trajectory:
            sampled = torch.cat([process.sample(self.realisations, virtual.generator) for process in processes])
            rows = torch.arange(len(latest), device=sampled.device).repeat_interleave(self.realisations)
            return batch_of(latest).rows(rows)._replace(exogenous=twin.plant.with_previews(sampled))

        self.closure_before = copy.deepcopy(twin.closure.state_dict())
        drawn = self.assimilation.config.inputs == "realisations"
        fit = self.assimilation.update(latest, draw if drawn else None)
        report = metrics(J_p_before=fit.start, J_p=fit.best, closure_gradient=fit.gradient, closure_refused=0.0)
        return merged(report, metrics(**self.assimilation.report()))
