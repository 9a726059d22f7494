r"""Simulation of a record from its first samples, with what the uncertainty of the twin makes of it.

The initial state is estimated from the first samples alone, under the identified weights; the twin then simulates the
whole record. To first order a simulated reading scatters by

.. math:: \mathrm{Var}\,\hat y_k = J_wC_wJ_w^\top + J_0C_0J_0^\top

with the covariances of the weights and of the initial state.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.fit.least_squares import Estimate, Estimation
from rt_torchrl.fit.likelihood import Likelihood
from rt_torchrl.fit.record import SensorRecord
from rt_torchrl.fit.uncertainty import inverse_information


class Prediction(NamedTuple):
    """A simulated record.

    Args:
        readings: simulated readings.
        errors: measured readings less simulated ones; NaN where a sample is missing.
        deviation: standard deviation of the simulated readings by the uncertainty of weights and initial state.
        noise: standard deviation of the sensors' noise.
        initial: initial state.
    """

    readings: Float[Tensor, "samples n_y"]
    errors: Float[Tensor, "samples n_y"]
    deviation: Float[Tensor, "samples n_y"]
    noise: Float[Tensor, " n_y"]
    initial: Float[Tensor, " n_s"]

    @property
    def rms(self) -> Float[Tensor, " n_y"]:
        """Root mean square error of every sensor over all samples, the first ones included."""
        return self.errors.square().nanmean(0).sqrt()

    def rms_interval(self, block: int, *, draws: int = 2000, seed: int = 0) -> tuple[float, float]:
        """95 % interval of the RMS error of the first sensor, by a bootstrap of blocks of neighbouring samples.

        Args:
            block: number of samples of a block, longer than the memory of the errors.
            draws: number of bootstrap samples.
            seed: seed of the draws.

        Raises:
            ValueError: if a block is not shorter than the record.
        """
        squares = self.errors[:, 0].square()
        squares = squares[~squares.isnan()]
        if not 1 <= block < len(squares):
            raise ValueError(f"block={block} of the bootstrap must lie between 1 and {len(squares) - 1} samples.")
        sums = squares.cumsum(0)
        means = (sums[block:] - sums[:-block]) / block
        count = math.ceil(len(squares) / block)
        picked = torch.randint(len(means), (draws, count), generator=torch.Generator().manual_seed(seed))
        found = means[picked].mean(-1).sqrt().quantile(torch.tensor([0.025, 0.975], dtype=torch.float64))
        low, high = found.tolist()
        return low, high


def predict(estimation: Estimation, estimate: Estimate, record: SensorRecord, *, first: int = 50) -> Prediction:
    """Simulate a record, with the initial state from its first samples.

    Args:
        estimation: the estimation, with the twin under the identified weights.
        estimate: its result, from other records or from this one.
        record: record to simulate.
        first: number of samples that the initial state is estimated from.

    Raises:
        ValueError: if there is no such sample.
        DivergenceError: if the twin diverges.
    """
    if first < 1:
        raise ValueError(f"first={first} samples of the record must be at least 1.")
    noise = estimate.likelihood.noise
    begun = estimation.fit_initial_states([record.masked(0, first)], noise)
    start = inverse_information(begun.normal_equations().matrix)
    whole = Likelihood(estimation.twin, [record], estimation.sensors, begun.initial, noise, biases=begun.biases)
    (block,) = whole.residuals()
    n = whole.weight_count
    C = estimate.uncertainty.weights_covariance
    by_weights, by_start = block.jacobian[0].split([n, block.jacobian.shape[-1] - n], -1)
    variance = ((by_weights @ C) * by_weights).sum(-1) + ((by_start @ start.matrix) * by_start).sum(-1)
    untold = estimate.uncertainty.untold(by_weights) | start.unknown(by_start)
    variance = torch.where(untold, torch.inf, variance)
    (simulated,) = whole.simulated()
    deviation = torch.where(record.seen, noise * variance.clamp_min(0.0).sqrt(), torch.nan)
    return Prediction(simulated, record.readings - simulated, deviation, noise.clone(), whole.initial().detach()[0])


class ResidualTests(NamedTuple):
    """Whether the errors of a simulation are noise: their correlations, with the bound for white noise.

    Args:
        auto: autocorrelation of the errors at lags 1, 2 ….
        cross: correlation of the errors with an action, at lags 0, 1 … of the action behind.
        bound: value that 95 % of the correlations of white noise do not exceed.
    """

    auto: Float[Tensor, " lags"]
    cross: Float[Tensor, " lags"]
    bound: float

    def describe(self) -> str:
        """The outcome in a sentence."""
        outside = [(x.abs() > self.bound).double().mean().item() for x in (self.auto, self.cross)]
        return (
            f"{outside[0]:.0%} of the autocorrelations and {outside[1]:.0%} of the correlations with the action lie "
            f"outside ±{self.bound:.3f}, where 5 % of those of white noise lie; neighbouring errors correlate by "
            f"{self.auto[0].item():.2f}"
        )


def residual_tests(prediction: Prediction, record: SensorRecord, *, lags: int = 25) -> ResidualTests:
    """Correlations of the errors of the first sensor, with themselves and with the first action.

    Raises:
        ValueError: if the record is not longer than the lags, or samples are missing.
    """
    e = prediction.errors[:-1, 0]
    if not 1 <= lags < len(e) or e.isnan().any():
        raise ValueError(f"lags={lags} of the residual tests need a longer record, without missing samples.")
    e, u = e - e.mean(), record.actions[:, 0] - record.actions[:, 0].mean()
    scale = e.norm() * u.norm()
    auto = torch.stack([(e[k:] * e[:-k]).sum() for k in range(1, lags + 1)]) / e.square().sum()
    cross = torch.stack([(e[k:] * u[: len(u) - k]).sum() for k in range(lags)]) / scale
    return ResidualTests(auto, cross, 1.96 / math.sqrt(len(e)))
