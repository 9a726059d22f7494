"""The exogenous input of the tank: the heat load of an orbit in and out of the sun."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field

from rt_torchrl.options import NotNegative, Positive, configuration
from rt_torchrl.plants.shapes import Draws


@configuration
class CyclicLoad:
    r"""Gaussian peaks once per orbit over a least load, with uniform noise (paper, section 5.3).

    .. math::
        Q_h(t) = \max\Big(0,\; Q_{min} + \hat Q\sum_j a_j\,e^{-(t - t_j)^2/(2\sigma^2)} + n(t)\Big), \quad
        t_j = (j + \tfrac12)\,T_h,

    with a_j uniform on 1 ± 0.1 and n uniform on ±√3 σ_n.

    Note: the paper prints no width of the peaks; here it is T_h/8, which leaves the load near its minimum for almost
    half of the orbit.

    Args:
        minimum: least load Q_min [W], not negative.
        peak: nominal height Q̂ of a peak above the least load [W], not negative.
        variation: largest relative departure of a peak's height, in [0, 1].
        period: period T_h of the orbit [s], positive.
        width: standard deviation σ of a peak in time [s], positive.
        noise: standard deviation σ_n of the noise [W], not negative; it is white, one value per sample.

    Raises:
        ValueError: if an argument is out of its range.
    """

    minimum: NotNegative = 50.0
    peak: NotNegative = 250.0
    variation: Annotated[float, Field(ge=0, le=1)] = 0.1
    period: Annotated[float, Field(ge=600)] = 5400.0  # an orbit close to the ground of the Earth takes 5060 s
    width: Positive = 675.0
    noise: NotNegative = 25.0

    @property
    def mean(self) -> float:
        """Mean load [W] over whole orbits; exact if the noise, within ±√3σ_n, never reaches the floor at zero."""
        return self.minimum + self.peak * self.width * math.sqrt(2.0 * math.pi) / self.period

    def draw(self, batch: int, n_steps: int, dt: float, generator: torch.Generator) -> Draws:
        """Heat load Q_h [W] of ``batch`` independent episodes, in float64 on the generator's device.

        Args:
            batch: number of episodes.
            n_steps: number of samples of each episode.
            dt: sampling interval [s].
            generator: source of the peaks' heights and of the noise.
        """
        like: dict[str, Any] = {"dtype": torch.float64, "device": generator.device}
        t = dt * torch.arange(n_steps, **like)
        orbit = (t / self.period).floor().long()
        # Peaks of other orbits count up to a distance of six standard deviations, e^{−18} = 1.5e-8 of their height.
        reach = math.ceil(6.0 * self.width / self.period)
        peaks = int(orbit[-1]) + 1 + 2 * reach
        height = 1.0 + self.variation * (2.0 * torch.rand(batch, peaks, generator=generator, **like) - 1.0)
        load = torch.full((batch, n_steps), self.minimum, **like)
        for j in range(-reach, reach + 1):
            distance = t - (orbit + j + 0.5) * self.period
            load += self.peak * height[:, orbit + j + reach] * torch.exp(-0.5 * (distance / self.width) ** 2)
        noise = 2.0 * torch.rand(batch, n_steps, generator=generator, **like) - 1.0
        return (load + math.sqrt(3.0) * self.noise * noise).clamp_min(0.0)
