"""Forecasts of the exogenous inputs over a planning horizon."""

from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

FUTURES = 8
"""Number of futures that takes no longer than one: machine code computes eight realisations side by side."""


@runtime_checkable
class Forecast(Protocol):
    """Anything that forecasts the exogenous inputs."""

    def __call__(
        self, t: float, exogenous: Float[Tensor, "batch n_z"], n: int
    ) -> Float[Tensor, "batch *futures {n} n_z"]:
        """The inputs of the n control intervals from t [s] on, of which the first is measured.

        A forecast gives one future or, in a dimension of their own, several that are equally probable.
        """


class Held:
    """The measured input, held."""

    def __call__(self, t: float, exogenous: Float[Tensor, "batch n_z"], n: int) -> Float[Tensor, "batch {n} n_z"]:
        return exogenous.unsqueeze(1).expand(-1, n, -1)


class Decaying:
    r"""The measured input decays to its mean, :math:`\hat z_{k+j} = \bar z + (z_k - \bar z)e^{-j\Delta t/\tau}`.

    Args:
        mean: mean of each input.
        time: decay time τ of each input [s].
        dt: control interval [s].

    Raises:
        ValueError: if a decay time is not positive.
    """

    def __init__(self, mean: Float[Tensor, " n_z"], time: Float[Tensor, " n_z"], *, dt: float):
        if not (time > 0.0).all():
            raise ValueError(f"time={time.tolist()} s of the decay must be positive.")
        self.mean, self.time, self.dt = mean, time, dt

    @classmethod
    def fitted(cls, records: Float[Tensor, "episodes n n_z"], *, dt: float, horizon: float) -> "Decaying":
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
        lags = round(horizon / dt)
        if not 1 <= lags < records.shape[1]:
            raise ValueError(
                f"horizon={horizon} s is {lags} control intervals; it must be at least one and below the "
                f"{records.shape[1]} of the records."
            )
        mean = records.mean((0, 1))
        spectrum = np.abs(np.fft.rfft((records - mean).numpy(), 2 * records.shape[1], axis=1)) ** 2
        number = records.shape[1] - np.arange(lags + 1)
        covariance = np.fft.irfft(spectrum.mean(0), axis=0)[: lags + 1] / number[:, None]
        times = [_decay_time(column, dt, records.shape[1] * dt) for column in covariance.T]
        return cls(mean, torch.tensor(times, dtype=torch.float64), dt=dt)

    def __call__(self, t: float, exogenous: Float[Tensor, "batch n_z"], n: int) -> Float[Tensor, "batch {n} n_z"]:
        share = torch.exp(-self.dt * torch.arange(n, dtype=torch.float64).unsqueeze(-1) / self.time)
        return self.mean + (exogenous - self.mean).unsqueeze(1) * share


class Scattered:
    r"""Several futures, which scatter about the decaying mean as a Gauss-Markov process does.

    .. math::
        z^{(i)}_{k+j} = \hat z_{k+j} + \sigma x^{(i)}_j, \qquad
        x_{j+1} = qx_j + \sqrt{1 - q^2}\,w_j, \qquad x_0 = 0, \qquad q = e^{-\Delta t/\tau}

    with standard normal w, so that far ahead the futures scatter as widely as the input itself. The draws w come in
    pairs ±w and are the same at every call, so that a plan changes with the measurement alone.

    Args:
        decaying: forecast of the mean.
        deviation: standard deviation σ of each input.
        low: least value of each input; futures below it are moved to it.
        high: greatest value of each input.
        futures: even number of futures.

    Raises:
        ValueError: if the number is not even and positive, or a deviation is negative.

    Source: Schildbach, Fagiano, Frei, Morari, *The scenario approach for stochastic model predictive control with
    bounds on closed-loop constraint violations*, Automatica 50 (2014) 3009.
    """

    def __init__(
        self,
        decaying: Decaying,
        deviation: Float[Tensor, " n_z"],
        *,
        low: Float[Tensor, " n_z"],
        high: Float[Tensor, " n_z"],
        futures: int = FUTURES,
    ):
        require_futures(futures)
        if not (deviation >= 0.0).all():
            raise ValueError(f"deviation={deviation.tolist()} of the inputs must not be negative.")
        self.decaying, self.deviation, self.low, self.high, self.futures = decaying, deviation, low, high, futures
        self._paths: tuple[tuple[int, list[float]], Tensor] | None = None

    @classmethod
    def fitted(
        cls,
        records: Float[Tensor, "episodes n n_z"],
        *,
        dt: float,
        horizon: float,
        low: Float[Tensor, " n_z"],
        high: Float[Tensor, " n_z"],
        futures: int = FUTURES,
    ) -> "Scattered":
        """The forecast of :meth:`Decaying.fitted`, with the standard deviation of the records."""
        decaying = Decaying.fitted(records, dt=dt, horizon=horizon)
        return cls(decaying, deviation_of(records), low=low, high=high, futures=futures)

    def __call__(
        self, t: float, exogenous: Float[Tensor, "batch n_z"], n: int
    ) -> Float[Tensor, "batch {self.futures} {n} n_z"]:
        scattered = self.decaying(t, exogenous, n).unsqueeze(1) + self.deviation * self._scatter(n)
        return scattered.clamp(self.low, self.high)

    def _scatter(self, n: int) -> Float[Tensor, "{self.futures} {n} n_z"]:
        """The deviations x of all futures."""
        from scipy.signal import lfilter  # here, because it takes a second to load and --help need not wait for it

        key = n, self.decaying.time.tolist()
        if self._paths is None or self._paths[0] != key:
            generator, q = torch.Generator().manual_seed(0), torch.exp(-self.decaying.dt / self.decaying.time)
            shape = self.futures // 2, n, len(q)
            drawn = torch.randn(shape, generator=generator, dtype=torch.float64) * (1.0 - q**2).sqrt()
            drawn[:, 1:], drawn[:, 0] = drawn[:, :-1].clone(), 0.0  # the first input is measured
            for i, share in enumerate(q.tolist()):
                drawn[..., i] = torch.from_numpy(lfilter([1.0], [1.0, -share], drawn[..., i].numpy()))
            self._paths = key, torch.cat([drawn, -drawn])
        return self._paths[1]


def require_futures(futures: int) -> None:
    """Refuse a number of futures that cannot be made of pairs.

    Raises:
        ValueError: if it is not even and positive.
    """
    if futures < 2 or futures % 2:
        raise ValueError(f"futures={futures} of a forecast must be even and at least 2, because they come in pairs.")


def deviation_of(records: Float[Tensor, "episodes n n_z"]) -> Float[Tensor, " n_z"]:
    """Standard deviation of each input about the mean of all records."""
    return (records - records.mean((0, 1))).square().mean((0, 1)).sqrt()


class Foreseen:
    """The inputs themselves for a time ahead, as a lidar measures them, and another forecast from there on.

    Args:
        record: inputs of whole episodes.
        dt: control interval [s].
        reach: time for which the inputs are known [s]; infinity for all of them.
        beyond: forecast beyond the reach, from the last input that is known.
    """

    def __init__(
        self,
        record: Float[Tensor, "batch n n_z"],
        *,
        dt: float,
        reach: float = float("inf"),
        beyond: Forecast | None = None,
    ):
        if not reach >= 0.0:
            raise ValueError(f"reach={reach} s of the inputs that are known must not be negative.")
        self.record, self.dt, self.reach, self.beyond = record, dt, reach, beyond or Held()

    def __call__(self, t: float, exogenous: Float[Tensor, "batch n_z"], n: int) -> Float[Tensor, "batch {n} n_z"]:
        k = round(t / self.dt)
        ahead = n if self.reach == float("inf") else min(n, 1 + int(self.reach / self.dt + 1e-9))
        known = self.record[:, k : k + ahead]
        if known.shape[1] == n:
            return known
        last = t + self.dt * (known.shape[1] - 1)
        return torch.cat([known, self.beyond(last, known[:, -1], n - known.shape[1] + 1)[:, 1:]], 1)


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
