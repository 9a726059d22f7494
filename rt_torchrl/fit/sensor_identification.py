"""Identification from the sensors of a log, trained on some of its segments and judged on others."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.fit.estimation import Estimate, Estimation
from rt_torchrl.fit.likelihood import Likelihood
from rt_torchrl.fit.sensor_record import SensorRecord
from rt_torchrl.trajectories.rollout import DivergenceError


class SensorJudgement(NamedTuple):
    """Result of a twin on records: RMS errors of the sensors, and the readings that it replays."""

    rms: Float[Tensor, " n_y"]
    readings: list[Tensor]


class SensorIdentified(NamedTuple):
    """Result of an identification: the estimate, and how well the twin replays both kinds of records.

    ``autocorrelation`` holds the correlation of neighbouring residuals of each sensor, near 0 for white noise.
    """

    estimate: Estimate
    training: tuple[SensorJudgement, SensorJudgement]  # before and after
    held_out: tuple[SensorJudgement, SensorJudgement]
    autocorrelation: Float[Tensor, " n_y"]


def identify(
    estimation: Estimation, training: Sequence[SensorRecord], held_out: Sequence[SensorRecord]
) -> SensorIdentified:
    """Estimate on some records and judge on both kinds, each with the initial states that suit it best.

    Raises:
        ValueError: if a sensor has no sample in the training records.
        DivergenceError: if the twin diverges under the weights that it starts from.
    """
    first = estimation.likelihood(training).noise
    before = [judged(estimation.fit_initial_states(records, first)) for records in (training, held_out)]
    estimate = estimation.run(training)
    likelihoods = [
        estimate.likelihood,
        estimation.fit_initial_states(held_out, estimate.likelihood.noise),
    ]
    after = [judged(likelihood) for likelihood in likelihoods]
    on_training, on_held_out = zip(before, after, strict=True)
    return SensorIdentified(estimate, on_training, on_held_out, autocorrelation(estimate.likelihood))


def judged(likelihood: Likelihood) -> SensorJudgement:
    """The twin's errors in the samples that exist; unknown if it diverges."""
    try:
        blocks = likelihood.residuals()
    except DivergenceError:
        return SensorJudgement(
            torch.full_like(likelihood.noise, torch.inf), [r.readings * torch.nan for r in likelihood.records]
        )
    squares, count = torch.zeros_like(likelihood.noise), torch.zeros_like(likelihood.noise)
    readings = []
    for block, record in zip(blocks, likelihood.records, strict=True):
        error = block.values * likelihood.noise
        squares, count = squares + error.square().sum(0), count + record.seen.sum(0)
        readings.append(record.readings + error)
    return SensorJudgement((squares / count).sqrt(), readings)


def autocorrelation(likelihood: Likelihood) -> Float[Tensor, " n_y"]:
    """Correlation of the residuals of neighbouring samples that exist, for each sensor."""
    products, squares = torch.zeros_like(likelihood.noise), torch.zeros_like(likelihood.noise)
    for block, record in zip(likelihood.residuals(), likelihood.records, strict=True):
        for k, seen in enumerate(record.seen.T):
            r = block.values[seen, k]
            products[k] += r[1:] @ r[:-1]
            squares[k] += r @ r
    return products / squares
