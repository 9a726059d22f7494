"""The exogenous input of the wind turbine: hub-height wind, synthetic or recorded."""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
import torch
from pydantic import Field

from rt_torchrl.envs.wind_turbine.turbsim import WindRecord
from rt_torchrl.options import Positive, Unbounded, configuration
from rt_torchrl.plants.sampling import DisturbanceModel
from rt_torchrl.plants.shapes import Draws

CUT_IN_WIND = 3.0
"""Cut-in wind speed of the NREL 5-MW turbine [m/s]; Jonkman et al., NREL/TP-500-38060, table 1-1."""


@runtime_checkable
class WindModel(DisturbanceModel, Protocol):
    """A model of the longitudinal wind speed u [m/s] that has a mean."""

    @property
    def mean(self) -> float:
        """Mean wind speed [m/s]."""
        ...


@configuration
class KaimalWind:
    r"""Hub-height longitudinal wind with the IEC Kaimal spectrum, made as TurbSim makes it.

    .. math::
        u(t) = U + \sum_{k=1}^{\lfloor n/2 \rfloor} \sqrt{2 S(f_k)\,\Delta f}\,\cos(2\pi f_k t + \varphi_k),\quad
        S(f) = \frac{4\sigma^2 L/U}{(1 + 6fL/U)^{5/3}},\quad f_k = k\,\Delta f,\; \Delta f = \frac1{n\,\Delta t}

    with :math:`\sigma = I U` and phases uniform on [0, 2π). The frequencies are multiples of 1/T up to the Nyquist
    frequency, so the record is periodic with its length T = n·dt, as TurbSim's is, and its mean is exactly U. Every
    sample is scaled, before the floor, to have the standard deviation σ (divisor n), as by TurbSim's ``ScaleIEC``: the
    band of a record of 600 s at 0.5 s holds (0.935 σ)², and the spectrum of the sample exceeds S by 14 %.

    Args:
        mean: mean speed U [m/s], positive.
        intensity: turbulence intensity I = σ/U [-], not negative; 0.16 is the reference value of class A.
        length_scale: integral scale L [m], positive; 340.2 m = 8.1·42 m, IEC 61400-1 for hubs above 60 m.
        floor: least wind speed [m/s], to which slower wind is raised; by default the turbine's cut-in, below which it
            does not run. ``-math.inf`` means no floor. At 11 m/s and 16 % the default lies 4.5 σ below the mean, and
            the wind hardly ever reaches it.

    Raises:
        ValueError: if an argument is out of its range.

    Source: IEC 61400-1 annex B; Jonkman, *TurbSim User's Guide*, NREL/TP-500-46198.
    """

    mean: Annotated[float, Field(gt=0, le=120)] = 11.0  # faster wind has not been measured at the height of a rotor
    intensity: Annotated[float, Field(ge=0, le=1)] = 0.16
    length_scale: Positive = 340.2
    floor: Unbounded = CUT_IN_WIND

    def __post_init__(self) -> None:
        if not self.floor < self.mean:
            raise ValueError(
                f"floor={self.floor} m/s of KaimalWind must be below the mean wind {self.mean} m/s; "
                "lower it, or pass -math.inf for none."
            )

    def draw(self, batch: int, n_steps: int, dt: float, generator: torch.Generator) -> Draws:
        """Wind speed u [m/s] of independent episodes, in float64 on the generator's device, by an inverse real FFT.

        Args:
            batch: number of episodes.
            n_steps: number of samples of each episode, at least 2: a single sample has no frequency.
            dt: sampling interval [s].
            generator: source of the phases.

        Raises:
            ValueError: if there are fewer samples.
        """
        if n_steps < 2:
            raise ValueError(f"n_steps={n_steps} of KaimalWind must be at least 2; lengthen the episode or shorten dt.")
        like: dict[str, Any] = {"dtype": torch.float64, "device": generator.device}
        f = torch.arange(1, n_steps // 2 + 1, **like) / (n_steps * dt)
        phase = 2.0 * math.pi * torch.rand(batch, len(f), generator=generator, **like)
        # The fluctuation has unit variance, so that a wind without turbulence is not scaled by 0/0.
        transit = self.length_scale / self.mean
        spectrum = 4.0 * transit / (1.0 + 6.0 * f * transit) ** (5.0 / 3.0)  # S/σ² [s], whose integral is 1
        amplitude = torch.sqrt(2.0 * spectrum / (n_steps * dt))
        coefficients = torch.polar((0.5 * n_steps * amplitude).expand_as(phase), phase)
        if n_steps % 2 == 0:
            # irfft counts a pair ±f for every bin but the Nyquist bin, which stands alone; there it drops the imaginary
            # part. The samples of a·cos(πk + φ) = a·cos φ·(−1)^k need n·a·cos φ in that bin. Without this line it would
            # carry a quarter of its power.
            coefficients[:, -1] = 2.0 * coefficients[:, -1].real
        fluctuation = torch.fft.irfft(torch.nn.functional.pad(coefficients, (1, 0)), n=n_steps)
        fluctuation = fluctuation / fluctuation.std(dim=-1, correction=0, keepdim=True)
        return (self.mean + self.intensity * self.mean * fluctuation).clamp_min(self.floor)


@configuration
class RecordedWind:
    """Wind cut at random from records, such as TurbSim's files.

    Every episode takes one of the records, which are equally likely, and a start in it, uniform over the starts that
    leave enough wind. The record is interpolated linearly to the start of each control interval, over which the wind is
    then held. Content above the new Nyquist frequency is folded, not filtered out.

    Args:
        records: at least one :class:`~rt_torchrl.envs.wind_turbine.turbsim.WindRecord`.
        floor: least wind speed [m/s], to which slower wind is raised; ``-math.inf`` means no floor.

    Raises:
        ValueError: if there is no record, or ``floor`` is not a number.
    """

    records: Annotated[Sequence[WindRecord], Field(min_length=1)]
    floor: Unbounded = CUT_IN_WIND

    @property
    def mean(self) -> float:
        """Mean wind speed of all records together [m/s]."""
        return float(np.concatenate([record.speed for record in self.records]).mean())

    def draw(self, batch: int, n_steps: int, dt: float, generator: torch.Generator) -> Draws:
        """Longitudinal wind speed u [m/s] of ``batch`` episodes, in float64 on the generator's device.

        Args:
            batch: number of episodes.
            n_steps: number of samples of each episode, at least 1.
            dt: sampling interval [s].
            generator: source of the choices of record and start.

        Raises:
            ValueError: if a record is shorter than (n_steps − 1)·dt.
        """
        needed = (n_steps - 1) * dt
        for record in self.records:
            # Rounding of k·dt must not reject a record that has exactly the needed length.
            if record.duration < needed * (1.0 - 1e-9):
                raise ValueError(
                    f"wind record {record.source} is {record.duration:g} s long, but n_steps={n_steps} of dt={dt} s "
                    f"need {needed:g} s; record more, shorten the episode or leave this record out."
                )
        device = generator.device
        choice = torch.randint(len(self.records), (batch,), generator=generator, device=device).tolist()
        share = torch.rand(batch, generator=generator, device=device, dtype=torch.float64).tolist()
        elapsed = dt * np.arange(n_steps)
        wind = np.empty((batch, n_steps))
        for row, index, part in zip(wind, choice, share, strict=True):
            record = self.records[index]
            start = part * max(0.0, record.duration - needed)
            # The record's times are an even grid, because a text file rounds the printed times to a millisecond.
            row[:] = np.interp(start + elapsed, record.step * np.arange(len(record.speed)), record.speed)
        return torch.as_tensor(wind, device=device).clamp_min(self.floor)
