"""Identification from a recorded log: a closure is trained without control, and judged on held-out segments."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.fit.covariance import named_values, standard_errors
from rt_torchrl.fit.output_error import NOISE_TOLERANCE, InitialStates, OutputError
from rt_torchrl.fit.sensor_log import SensorLog, logged_states
from rt_torchrl.optimisers.descent import Descent, DescentConfig
from rt_torchrl.optimisers.levenberg_marquardt import LevenbergMarquardt
from rt_torchrl.options import check_options
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import differences
from rt_torchrl.trajectories.sensitivity import Sensitivities
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

Optimiser = Literal["levenberg_marquardt", "adam", "lbfgs"]


@dataclass(frozen=True, kw_only=True)
class IdentificationConfig:
    """Parameters of an identification.

    Args:
        iterations: trial steps of each descent, see :class:`Identification`.
        optimiser: method of the descent: levenberg_marquardt for closures of some ten weights, or adam or lbfgs for
            closures of more weights.
        rate: learning rate of adam, or first step length of lbfgs.
        initial: initial state of each segment: estimated, as an unknown of which the first sample is a measurement, or
            measured, as in the first sample.
    """

    iterations: int = 30
    optimiser: Optimiser = "levenberg_marquardt"
    rate: float = 0.1
    initial: Literal["estimated", "measured"] = "estimated"

    def __post_init__(self) -> None:
        check_options(self)
        if self.iterations < 1:
            raise ValueError(f"iterations={self.iterations} of the identification must be at least 1.")
        if not self.rate > 0.0:
            raise ValueError(f"rate={self.rate} of the identification must be positive.")


class Judgement(NamedTuple):
    """Result of a twin on segments: the sum of J_p, the total length [s], RMS errors, and the states as replayed."""

    J_p: float
    seconds: float
    rms: Float[Tensor, " n_s"]
    states: list[Tensor]


class Identified(NamedTuple):
    """Result of an identification; the closure itself is trained in place."""

    weights: dict[str, dict[str, float]]  # by name: before, after and standard_error of each weight
    training: tuple[Judgement, Judgement]  # before and after
    held_out: tuple[Judgement, Judgement]
    autocorrelation: Float[Tensor, " n_s"]  # correlation of neighbouring residuals; near 0 for white noise
    iterations: int


class Identification:
    """Trains a closure on segments of a log.

    The logged actions and the logged exogenous input drive the twin, and the plant's own J_p compares it with the log.
    If initial states are unknown, the closure is trained in two ways, and the weights with the lower J_p stay. The
    first way descends over weights and initial states together; there, initial states can drift to make up for weights
    that are far off. The second way descends over the weights alone, then over both; there, the error of a first sample
    can drive the weights to where the states no longer depend on them.

    Args:
        plant: physics of the twin.
        closure: closure of the twin, trained in place.
        free: indices of the states whose initial value is estimated, see :func:`measured_states`.
        config: parameters of the identification.
    """

    def __init__(
        self,
        plant: Plant,
        closure: nn.Module,
        *,
        free: Sequence[int],
        config: IdentificationConfig,
    ):
        self.twin, self.config = DigitalTwin(plant, closure), config
        self.free = tuple(free) if config.initial == "estimated" else ()
        self._sensitivities = Sensitivities(plant, closure)

    def run(self, training: Sequence[Trajectory], held_out: Sequence[Trajectory]) -> Identified:
        """Train on some segments and judge on both kinds; the initial states of both are treated the same way.

        Raises:
            DivergenceError: if the twin diverges under the weights that it starts from.
        """
        closure, both = self.twin.closure, (training, held_out)
        before = [self.judge(segments) for segments in both]
        start = coefficients(closure)
        output_error, done = self._train(training)
        errors = standard_errors(output_error)
        after = [self.judge(segments) for segments in both]
        weights = {
            name: {"before": start[name], "after": value, "standard_error": errors[name]}
            for name, value in coefficients(closure).items()
        }
        autocorrelation = lag_one(self.twin.plant, training, after[0].states)
        on_training, on_held_out = zip(before, after, strict=True)
        return Identified(weights, on_training, on_held_out, autocorrelation, done)

    def judge(self, segments: Sequence[Trajectory]) -> Judgement:
        """Judge the twin with its present weights.

        It starts from the initial states that suit it best if these are estimated, otherwise from the measured ones.
        """
        plant = self.twin.plant
        output_error = self._output_error(segments, self.free, weights=False)
        if self.free:
            output_error.fit_initial_states()
        states = [replayed.states for replayed in output_error.replays()]
        measured = [segment.states for segment in segments]
        J_p = sum(plant.dt * plant.discrepancy(s, m).sum().item() for s, m in zip(states, measured, strict=True))
        error = differences(plant.states, torch.cat(states), torch.cat(measured))
        seconds = plant.dt * sum(len(m) for m in measured)
        return Judgement(J_p, seconds, (error**2).mean(0).sqrt(), states)

    def _output_error(
        self, segments: Sequence[Trajectory], free: Sequence[int], *, weights: bool = True
    ) -> OutputError:
        initial = InitialStates.estimated(self.twin, segments, free, self._sensitivities)
        return OutputError(self.twin, segments, initial, weights=weights, sensitivities=self._sensitivities)

    def _train(self, segments: Sequence[Trajectory]) -> tuple[OutputError, int]:
        """The output error at its minimum, and the number of trial steps.

        If initial states are unknown, both ways of :class:`Identification` are taken.
        """
        closure = self.twin.closure
        start = copy.deepcopy(closure.state_dict())
        together = self._output_error(segments, self.free)
        done = self._descend(together)
        if not self.free:
            return together, done
        found, J_p = copy.deepcopy(closure.state_dict()), together.normal_equations().cost
        closure.load_state_dict(start)
        done += self._descend(self._output_error(segments, ()))
        staged = self._output_error(segments, self.free)
        done += self._descend(staged)
        if staged.normal_equations().cost < J_p:
            return staged, done
        closure.load_state_dict(found)
        return together, done

    def _descend(self, output_error: OutputError) -> int:
        iterations = self.config.iterations
        if self.config.optimiser == "levenberg_marquardt":
            optimiser = LevenbergMarquardt(output_error.unknowns, tolerance=NOISE_TOLERANCE)
            return optimiser.run(output_error.normal_equations, iterations).iterations
        descent = Descent(output_error.unknowns, DescentConfig(optimiser=self.config.optimiser, rate=self.config.rate))
        return descent.run(output_error.cost, iterations).iterations


def measured_states(plant: Plant, log: SensorLog) -> list[int]:
    """Indices of the plant's states that a log holds."""
    names = [state.name for state in logged_states(plant) if state.name in log.columns]
    return [k for k, state in enumerate(plant.states) if state.name in names]


def coefficients(closure: nn.Module) -> dict[str, float]:
    """The closure's weights by name; they are in physical units if the closure has ``named_coefficients``."""
    return {name: value.item() for name, value in named_values(closure).items()}


def lag_one(plant: Plant, segments: Sequence[Trajectory], states: Sequence[Tensor]) -> Float[Tensor, " n_s"]:
    """Correlation of the residuals of neighbouring samples, for each state; nan for a state without residuals."""
    pairs = zip(states, segments, strict=True)
    residuals = [differences(plant.states, found, segment.states) for found, segment in pairs]
    none = residuals[0].new_zeros(len(plant.states))
    products = sum(((r[1:] * r[:-1]).sum(0) for r in residuals), start=none)
    return products / sum(((r**2).sum(0) for r in residuals), start=none)


def held_back(plant: Plant, segments: Sequence[Trajectory]) -> dict[str, float]:
    """Share of the control intervals in which the plant's actuators would not have applied the logged action.

    In these intervals the action that the actuators allow drives the twin. They are a sign of wrong rate limits, units
    or columns.
    """
    found = []
    for segment in segments:
        allowed = plant.actuate(segment.states[:-1], segment.actions)
        found.append((allowed - segment.actions).abs() > 1e-6 * segment.actions.abs().amax(0).clamp_min(1e-12))
    return dict(zip((a.name for a in plant.actions), torch.cat(found).double().mean(0).tolist(), strict=True))
