"""Forecasts of the exogenous inputs over a planning horizon."""

from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.shapes import Input, Inputs

Futures = Float[Tensor, "batch n_futures {n} n_z"]
"""Exogenous inputs of n control intervals in each future."""
WINDOWS = 100
"""Number of windows of a record in which the errors of a forecast are taken; neighbours say nearly the same."""


@runtime_checkable
class Forecast(Protocol):
    """Anything that forecasts the exogenous inputs: one future, or several that are equally likely."""

    def __call__(self, t: float, exogenous: Input, n: int) -> Futures:
        """The inputs of the n control intervals from t [s] on in each future, of which the first are measured."""


class Held:
    """The measured input, held."""

    def __call__(self, t: float, exogenous: Input, n: int) -> Futures:
        return exogenous[:, None, None].expand(-1, -1, n, -1)


class Decaying(nn.Module):
    r"""The measured input decays to its mean, :math:`\hat z_{k+j} = \bar z + (z_k - \bar z)e^{-j\Delta t/\tau}`.

    Args:
        mean: mean of each input.
        time: decay time τ of each input [s]; infinity holds it.
        dt: control interval [s].

    Raises:
        ValueError: if a decay time is not positive.
    """

    mean: Tensor
    time: Tensor

    def __init__(self, mean: Float[Tensor, " n_z"], time: Float[Tensor, " n_z"], *, dt: float):
        super().__init__()
        if not (time > 0.0).all():
            raise ValueError(f"time={time.tolist()} s of the decay must be positive.")
        self.register_buffer("mean", mean)
        self.register_buffer("time", time)
        self.dt = dt

    @classmethod
    def fitted(cls, records: Inputs, *, dt: float, horizon: float) -> "Decaying":
        r"""The decay times of the least mean squared error of the forecast over the horizon.

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
        lags = lags_within(records, dt=dt, horizon=horizon)
        mean = records.mean((0, 1))
        spectrum = np.abs(np.fft.rfft((records - mean).numpy(), 2 * records.shape[1], axis=1)) ** 2
        number = records.shape[1] - np.arange(lags + 1)
        covariance = np.fft.irfft(spectrum.mean(0), axis=0)[: lags + 1] / number[:, None]
        times = [_decay_time(column, dt, records.shape[1] * dt) for column in covariance.T]
        return cls(mean, torch.tensor(times, dtype=torch.float64), dt=dt)

    def forward(self, t: float, exogenous: Input, n: int) -> Futures:
        share = torch.exp(-self.dt * torch.arange(n, dtype=torch.float64).unsqueeze(-1) / self.time)
        return self.mean + (exogenous - self.mean)[:, None, None] * share


class Foreseen:
    """The inputs themselves, as if a lidar measured them however far ahead; after their end the last one holds.

    Args:
        record: inputs of whole episodes.
        dt: control interval [s].
    """

    def __init__(self, record: Inputs, *, dt: float):
        self.record, self.dt = record, dt

    def __call__(self, t: float, exogenous: Input, n: int) -> Futures:
        last = self.record.shape[1] - 1
        return self.record[:, None, (round(t / self.dt) + torch.arange(n)).clamp(max=last)]


class Scattered(nn.Module):
    r"""Equally likely futures in pairs about another forecast, as its errors on records scatter.

    .. math::
        z^{(\pm i)}_{k+j} = \hat z_{k+j} \pm d_{ij}, \qquad d_i = \sqrt{m\,\mu_i}\,v_i, \qquad i = 1 \dots m

    with the m greatest eigenvalues μ_i and eigenvectors v_i of the second moments of the errors over a horizon, in
    which every input counts in units of its standard deviation. The 2m futures have the forecast as their mean and, in
    these m directions, the second moments of its errors. No future leaves the range of the records.

    Args:
        forecast: the forecast in the middle.
        deviations: deviations d_i; the last ones hold beyond the horizon.
        low: least recorded value of each input.
        high: greatest recorded value of each input.
    """

    deviations: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self,
        forecast: Forecast,
        deviations: Float[Tensor, "pairs n n_z"],
        low: Float[Tensor, " n_z"],
        high: Float[Tensor, " n_z"],
    ):
        super().__init__()
        self.forecast = forecast
        for name, value in {"deviations": deviations, "low": low, "high": high}.items():
            self.register_buffer(name, value)

    @classmethod
    def fitted(cls, forecast: Forecast, records: Inputs, *, dt: float, horizon: float, pairs: int = 4) -> "Scattered":
        """The scatter of a forecast's errors on records.

        Args:
            forecast: the forecast.
            records: recorded inputs of episodes.
            dt: control interval [s].
            horizon: time over which errors are taken [s].
            pairs: number m of pairs of futures.

        Raises:
            ValueError: if the records are not longer than the horizon, or do not have as many directions as pairs.
        """
        lags = lags_within(records, dt=dt, horizon=horizon)
        episodes, length, n_z = records.shape
        places = np.unique(np.linspace(0, length - 1 - lags, WINDOWS).round().astype(int)).tolist()
        if not 1 <= pairs <= min(episodes * len(places), lags * n_z):
            raise ValueError(
                f"pairs={pairs} of futures must be at least 1, and at most the number of inputs that are forecast, "
                f"{lags * n_z}, and of recorded windows, {episodes * len(places)}."
            )
        errors = torch.cat(
            [records[:, k : k + lags + 1] - forecast(k * dt, records[:, k], lags + 1)[:, 0] for k in places]
        )
        scale = records.std((0, 1), correction=0)
        scale = torch.where(scale > 0.0, scale, 1.0)
        root = (errors / scale).flatten(1) / len(errors) ** 0.5
        _, sizes, directions = torch.linalg.svd(root, full_matrices=False)
        deviations = (pairs**0.5 * sizes[:pairs, None] * directions[:pairs]).reshape(pairs, lags + 1, n_z) * scale
        return cls(forecast, deviations, records.amin((0, 1)), records.amax((0, 1)))

    def forward(self, t: float, exogenous: Input, n: int) -> Futures:
        """The futures, those with added deviations first."""
        change = self.reaching(n)
        found = self.forecast(t, exogenous, n) + torch.cat([change, -change])
        found = torch.maximum(torch.minimum(found, self.high), self.low)
        found[:, :, 0] = exogenous.unsqueeze(1)  # what is measured is certain
        return found

    def reaching(self, n: int) -> Float[Tensor, "pairs {n} n_z"]:
        """The deviations of n control intervals."""
        return self.deviations[:, torch.arange(n).clamp(max=self.deviations.shape[1] - 1)]


def lags_within(records: Inputs, *, dt: float, horizon: float) -> int:
    """The number of control intervals of a horizon [s].

    Raises:
        ValueError: if the records are not longer than the horizon.
    """
    lags = round(horizon / dt)
    if not 1 <= lags < records.shape[1]:
        raise ValueError(
            f"horizon={horizon} s is {lags} control intervals; it must be at least one and below the "
            f"{records.shape[1]} of the records."
        )
    return lags


def _decay_time(covariance: Float[np.ndarray, " lags"], dt: float, longest: float) -> float:
    """The decay time [s] of the least forecast error, between a tenth of an interval and the length of a record."""
    from scipy.optimize import minimize_scalar  # here, because it takes a second to load and --help need not wait

    steps = np.arange(len(covariance))

    def error(log_time: float) -> float:
        share = np.exp(-dt * steps / np.exp(log_time))
        return float((covariance[0] * (1.0 + share**2) - 2.0 * share * covariance).sum())

    ends = np.log(0.1 * dt), np.log(longest)
    grid = np.linspace(*ends, 60)
    k = int(np.argmin([error(x) for x in grid]))
    around = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
    return float(np.exp(minimize_scalar(error, bounds=around, method="bounded").x))
