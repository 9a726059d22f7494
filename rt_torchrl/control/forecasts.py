"""Forecasts of the exogenous inputs over a planning horizon."""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.shapes import Input, Inputs

Forecast = Callable[[float, Input, int], Inputs]
"""A function of time t [s], measured inputs and n: the inputs of the n control intervals from t on."""


def held(t: float, exogenous: Input, n: int) -> Inputs:
    """The measured inputs, held."""
    return exogenous.unsqueeze(1).expand(-1, n, -1)


class Decaying(nn.Module):
    r"""The measured input decays to its mean, :math:`\hat z_{k+j} = \bar z + (z_k - \bar z)e^{-j\Delta t/\tau}`.

    Args:
        mean: mean of each input.
        time: decay time τ of each input [s]; infinity holds it.
        dt: control interval [s].

    Raises:
        ValueError: if a decay time is not positive.
    """

    def __init__(self, mean: Float[Tensor, " n_z"], time: Float[Tensor, " n_z"], *, dt: float):
        super().__init__()
        if not (time > 0.0).all():
            raise ValueError(f"time={time.tolist()} s of the decay must be positive.")
        self.mean = nn.Buffer(mean)
        self.time = nn.Buffer(time)
        self.dt = dt

    @classmethod
    def fitted(cls, records: Inputs, *, dt: float, horizon: float) -> "Decaying":
        r"""The decay times of the least mean squared error of the forecast over the horizon, or infinite ones.

        .. math::
            \sum_{j\le N}\mathrm E(z_{k+j} - \hat z_{k+j})^2 = \sum_{j\le N}\Gamma_0 - 2q^j\Gamma_j + q^{2j}\Gamma_0

        with the sample covariances Γ_j of the records and q = e^{−Δt/τ}.

        Args:
            records: recorded inputs of episodes.
            dt: control interval [s].
            horizon: time over which the error is summed [s].

        Raises:
            ValueError: if the records are not longer than the horizon.
        """
        lags = round(horizon / dt)
        if not 1 <= lags < records.shape[1]:
            raise ValueError(
                f"horizon={horizon} s is {lags} control intervals; it must be at least one and below the "
                f"{records.shape[1]} of the records."
            )
        mean, changes = records.mean((0, 1)), records - records[0, 0]  # which are exactly zero where nothing moves
        spectrum = np.abs(np.fft.rfft((changes - changes.mean((0, 1))).numpy(), 2 * records.shape[1], axis=1)) ** 2
        number = records.shape[1] - np.arange(lags + 1)
        covariance = np.fft.irfft(spectrum.mean(0), axis=0)[: lags + 1] / number[:, None]
        times = [_decay_time(column, dt, records.shape[1] * dt) for column in covariance.T]
        return cls(mean, torch.tensor(times, dtype=torch.float64), dt=dt)

    def forward(self, t: float, exogenous: Input, n: int) -> Inputs:
        share = torch.exp(-self.dt * torch.arange(n, dtype=torch.float64).unsqueeze(-1) / self.time)
        return self.mean + (exogenous - self.mean).unsqueeze(1) * share


def _decay_time(covariance: Float[np.ndarray, " lags"], dt: float, longest: float) -> float:
    """The decay time [s] of the least forecast error, between a tenth of an interval and a record, or infinite."""
    from scipy.optimize import minimize_scalar  # here, because it takes a second to load and --help need not wait

    steps = np.arange(len(covariance))

    def error(log_time: float) -> float:
        share = np.exp(-dt * steps / np.exp(log_time))
        return float((covariance[0] * (1.0 + share**2) - 2.0 * share * covariance).sum())

    ends = np.log(0.1 * dt), np.log(longest)
    grid = np.linspace(*ends, 60)
    k = int(np.argmin([error(x) for x in grid]))
    around = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
    best = minimize_scalar(error, bounds=around, method="bounded")
    return math.inf if error(math.inf) <= best.fun else float(np.exp(best.x))
