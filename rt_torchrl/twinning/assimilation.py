"""Step 4: the closure is trained until the twin replays the record."""

import contextlib
import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from rt_torchrl.fit.least_squares import EXPLAINED, NOISE_TOLERANCE, Estimation, multi_start, over_segments
from rt_torchrl.fit.likelihood import Likelihood
from rt_torchrl.fit.prior import WeightPrior
from rt_torchrl.fit.record import SensorRecord, sensor_records
from rt_torchrl.fit.sensors import state_places, state_sensors
from rt_torchrl.optimisers.descent import Descended, Descent, DescentConfig
from rt_torchrl.optimisers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from rt_torchrl.options import check_options
from rt_torchrl.steps.inputs import ExogenousProcess
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of, identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin

DAMPING = 1e-3
"""Damping μ of the first fit by Levenberg-Marquardt."""


@dataclass(frozen=True, kw_only=True)
class AssimilationConfig:
    """Parameters of step 4.

    Args:
        iterations: number n_G of gradients per episode.
        stop_ratio: share of the J_p at the start of the episode below which the descent ends; with 0 it never ends
            early.
        inputs: exogenous input of the replay: ``realisations`` for N_z samples of the exogenous process, as in the
            paper, or ``record`` for the measured input. With realisations a twin does not fit chance in the input, but
            it also does not find weights that move the states less than that chance does.
        method: method of the fit: ``gradient`` takes the steps of ``descent``; ``levenberg_marquardt`` solves the
            normal equations from forward sensitivities, for closures of some ten weights, and does not use ``descent``.
        starts: number of first weights in every episode: the present ones, those of the first closure, and then these
            two in turns, moved at random. The best fit stays, as a law that has bent to one record may be in a local
            minimum of the next ones. More than 1 needs ``levenberg_marquardt`` and ``initial="measured"``.
        prior: factor ρ of a cost ½ρ‖w − w⁰‖² beside J_p, in the unit of J_p, on the weights w of the closure's
            perceptrons (:class:`BoundedPerceptron`); 0 leaves it out. Weights of which the records say nothing then
            keep their initial values, and so the law keeps its initial form where no record has been.
        segment: number of control intervals after which the replay starts again from the measured state (multiple
            shooting); 0 replays whole records, as in the paper. Over short segments the states are nearly linear in the
            weights, so a closure with many weights fits the record in a few steps. The J_p that descends is then the
            mean over the segments. None lets the data choose: whole records, unless the twin leaves them where it
            follows shorter segments, as with an unstable system; J_p is then told over the segments that are chosen.
        initial: first state of a replay: ``measured`` for the first reading of the sensors, as in the paper, or
            else ``estimated``, with which the components that J_p compares are unknowns beside the weights. A plant
            that forgets slowly carries the error of the first reading through the whole record, and the weights would
            make up for it. The choice ``estimated`` needs ``levenberg_marquardt`` and the inputs of the ``record``.
        sensors: names of the states and measurements that sensors read, to which the twin is fitted by maximum
            likelihood; none for the plant's J_p of the whole state. Noise levels are estimated, and so are first
            states, about what the plant usually draws. The prior is then the stiffness of the likelihood, J_p is half
            the mean square of the residuals in units of the noise, and ``stop_ratio`` has no effect. Sensors need
            ``levenberg_marquardt``, the inputs of the ``record``, ``initial="estimated"`` and whole records.
        biased: names of the sensors that may be off by a constant, which is estimated.
        pushes: number of parts of a record between which something beside the twin may push the states (weak
            constraint); 1 for none. The pushes are unknowns beside the weights, which they then bend no longer.
        push: size of a push, its standard deviation as a share of each state's usual size.
        drift: standard deviation by which each weight of the closure may change from episode to episode, where a change
            of 1 is a factor of e for a logarithm. What earlier episodes told is then kept as a belief that fades, and
            each episode adds its record. With 0 the records alone tell the weights.
        descent: parameters of the closure's descent.
    """

    iterations: int = 15
    stop_ratio: float = 0.0
    inputs: Literal["realisations", "record"] = "realisations"
    method: Literal["gradient", "levenberg_marquardt"] = "gradient"
    starts: int = 1
    prior: float = 0.0
    segment: int | None = 0
    initial: Literal["measured", "estimated"] = "measured"
    sensors: tuple[str, ...] = ()
    biased: tuple[str, ...] = ()
    pushes: int = 1
    push: float = 0.01
    drift: float = 0.0
    descent: DescentConfig = field(default_factory=DescentConfig)

    def __post_init__(self) -> None:
        check_options(self)
        if self.iterations < 0:
            raise ValueError(f"iterations={self.iterations} of the assimilation (n_G) must not be negative.")
        if not 0.0 <= self.stop_ratio < 1.0:
            raise ValueError(f"stop_ratio={self.stop_ratio} must lie in [0, 1).")
        if not self.prior >= 0.0:
            raise ValueError(f"prior={self.prior} of the closure's weights must not be negative.")
        if self.segment is not None and self.segment < 0:
            raise ValueError(f"segment={self.segment} control intervals must not be negative; 0 replays whole records.")
        if self.initial == "estimated" and (self.method, self.inputs) != ("levenberg_marquardt", "record"):
            raise ValueError(
                f"initial='estimated' of the assimilation needs method='levenberg_marquardt' and inputs='record'; they "
                f"are {self.method!r} and {self.inputs!r}."
            )
        if self.sensors and (self.initial != "estimated" or self.segment != 0):
            raise ValueError(
                f"sensors={self.sensors} of the assimilation need initial='estimated' and segment=0; they are "
                f"{self.initial!r} and {self.segment}."
            )
        if self.starts < 1 or (self.starts > 1 and (self.method, self.initial) != ("levenberg_marquardt", "measured")):
            raise ValueError(
                f"starts={self.starts} of the assimilation must be at least 1, and more than 1 need "
                f"method='levenberg_marquardt' and initial='measured', not {self.method!r} and {self.initial!r}."
            )
        self._check_likelihood()

    def _check_likelihood(self) -> None:
        """Check what only a fit to sensors takes."""
        if self.pushes < 1 or not self.push > 0.0:
            raise ValueError(f"pushes={self.pushes} must be at least 1, and push={self.push} positive.")
        if not self.drift >= 0.0:
            raise ValueError(f"drift={self.drift} of the closure's weights must not be negative.")
        if not self.sensors and (self.biased or self.pushes > 1 or self.drift):
            raise ValueError(
                f"biased={self.biased}, pushes={self.pushes} and drift={self.drift} of the assimilation belong to a "
                "fit to sensors; give sensors, too."
            )


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
        self.descent = Descent(twin.closure, config.descent)
        self.damping = DAMPING
        """Damping μ with which the next fit by Levenberg-Marquardt begins."""
        sensors = state_sensors(twin.plant)
        spread = torch.zeros(len(twin.plant.states), dtype=torch.float64)
        if config.initial == "estimated":
            spread[[k for k in state_places(twin.plant, sensors) if k is not None]] = math.inf
        self._problem = Estimation(twin, sensors, spread=spread)
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
            J_p of the whole records before and after, without the prior, and the descent's gradient and iterations.
            J_p before is infinite if the twin diverges on the records; the fit then begins anew from the first closure.
            Where the twin diverges under that, too, all are infinite, and the closure stays as it is.
        """
        whole = batch_of(records)
        if self.config.inputs == "realisations":
            sampled = torch.cat([process.sample(count, generator) for process in processes])
            rows = torch.arange(len(whole.states), device=sampled.device).repeat_interleave(count)
            whole = whole.rows(rows)._replace(exogenous=self.twin.plant.with_previews(sampled))
        if self.config.segment is None and self.config.iterations:
            return self._over_segments(whole)
        if not self.config.segment:
            return self._descend_anew(whole)
        before = self.cost_of(whole)
        found = self._descend_anew(whole.segments(min(self.config.segment, whole.actions.shape[1]), self.twin.plant.dt))
        return found._replace(start=before, best=self.cost_of(whole))

    def _over_segments(self, whole: Trajectory) -> Descended:
        """Descend over whole records, or over the longest segments that the twin follows as well as shorter ones."""
        plant, intervals = self.twin.plant, whole.actions.shape[1]
        scatter = plant.discrepancy(whole.states, whole.states.mean(1, keepdim=True).expand_as(whole.states)).mean()

        def fit(length: int) -> tuple[Descended, Tensor]:
            found = self._descend_anew(whole.segments(length, plant.dt) if length else whole)
            return found, torch.tensor(found.best / (plant.dt * (length or intervals)), dtype=torch.float64).sqrt()

        return over_segments(self.twin.closure, intervals, fit, EXPLAINED * scatter.sqrt().cpu())

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
        before, config = self.prior.cost().item(), self.config
        if config.method == "levenberg_marquardt":
            found = self._least_squares(replayed)
        else:
            found = self.descent.run(
                lambda: self._identification_cost(replayed) + self.prior.cost(),
                config.iterations,
                stop_below=config.stop_ratio,
            )
        if math.isinf(found.start):
            raise FloatingPointError("J_p of finite states overflows")
        return found._replace(start=found.start - before, best=found.best - self.prior.cost().item())

    def _least_squares(self, replayed: Trajectory) -> Descended:
        """Descend by Levenberg-Marquardt from each of the first weights; the best weights stay."""
        config, tolerance = self.config, 1e-4 if self.config.initial == "measured" else NOISE_TOLERANCE

        def descend(number: int) -> Descended:
            likelihood = self.likelihood(replayed, prior=self.prior)
            method = LevenbergMarquardt(
                likelihood.unknowns, damping=DAMPING if number else self.damping, tolerance=tolerance
            )
            stop_below = 0.0 if number else config.stop_ratio
            found = method.run(likelihood.normal_equations, config.iterations, stop_below=stop_below)
            if not number:
                self.damping = method.damping
            return found

        found = multi_start(self.twin.closure, config.starts, descend, first=self.first)
        return found[0]._replace(best=min((one.best for one in found), default=math.nan))

    def _identification_cost(self, replayed: Trajectory) -> Tensor:
        states, actions, exogenous, start, seen = replayed
        flown = self.twin.replay(states[:, 0], exogenous, actions, start=start)
        return identification_cost(self.twin.plant, flown, states, seen).mean()

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
        return sensor_records(self.twin.plant, sensors, replayed), noise

    def normal_equations(self, replayed: Trajectory) -> NormalEquations:
        """J_p, gradient and Gauss-Newton matrix by all unknowns; DivergenceError if a state is not finite."""
        return self.likelihood(replayed).normal_equations()

    def explain(self, difference: float, generator: torch.Generator) -> bool:
        """Seek in the records of the last update why real episodes cost other than the twin says.

        Returns:
            Whether the twin has changed; a twin alone has nothing to try.
        """
        return False

    def report(self) -> Mapping[str, float | str]:
        """What the last update has found beside J_p, by name; of one twin, nothing."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next update depends on, except the closure."""
        return {"descent": self.descent.state_dict(), "damping": self.damping, "first": self.first}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.descent.load_state_dict(state["descent"])
        self.damping = state["damping"]
        if "first" in state:  # earlier versions did not save it
            closure = self.twin.closure
            present = copy.deepcopy(closure.state_dict())
            closure.load_state_dict(state["first"])
            self.begin()
            closure.load_state_dict(present)
