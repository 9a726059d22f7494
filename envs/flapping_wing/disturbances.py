"""The exogenous input of the flapping wing: a gusty headwind."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field

from rt_torchrl.options import configuration
from rt_torchrl.plants.shapes import Draws


@configuration
class GaussianGust:
    r"""Stationary Gaussian process with a squared-exponential kernel (paper, section 5.2).

    .. math::
        u_\infty \sim \mathcal{GP}\big(\bar u, \kappa(\tau)\big), \qquad
        \kappa(\tau) = \sigma_u^2\,e^{-\tau^2/(2\sigma_f^2)}

    It is drawn as a Fourier series whose period P exceeds the record by nine time scales,

    .. math::
        u_\infty(t) = \bar u + \sigma_u\sum_{k=0}^{K} \sqrt{c_k}\,(a_k\cos\omega_kt + b_k\sin\omega_kt), \quad
        \omega_k = \frac{2\pi k}{P}, \quad
        c_k = (2 - \delta_{k0})\,\frac{\sqrt{2\pi}\,\sigma_f}{P}\,e^{-\omega_k^2\sigma_f^2/2},

    with a_k, b_k standard normal. This is circulant embedding, with the eigenvalues of the circulant in closed form. By
    Poisson's sum the covariance of the series is Σ_m κ(τ + mP). Over the record it differs from κ(τ) by e^{−40}, which
    is below rounding; the end of the series at ω_K σ_f = 9 costs no more. Five seconds of the paper's wind need 17
    harmonics, while a Cholesky factor would have 10⁸ entries. A smaller dt samples the same function of time.

    Note: the paper prints no variance; here it is 1 (m/s)², that of the kernel as printed.

    Args:
        mean: mean headwind ū [m/s]; positive blows towards −x.
        std: standard deviation σ_u [m/s], not negative.
        time_scale: time scale σ_f of the kernel [s], positive.

    Raises:
        ValueError: if an argument is out of its range.

    Source: Dietrich and Newsam, *SIAM J. Sci. Comput.* 18 (1997) 1088.
    """

    mean: Annotated[float, Field(ge=-30, le=30)] = 1.0  # no drone flies in faster wind
    std: Annotated[float, Field(ge=0, le=30)] = 1.0
    time_scale: Annotated[float, Field(gt=0, le=3600)] = 3.0

    def draw(self, batch: int, n_steps: int, dt: float, generator: torch.Generator) -> Draws:
        """Headwind u_∞ [m/s] of ``batch`` independent episodes, in float64 on the generator's device.

        Args:
            batch: number of episodes.
            n_steps: number of samples of each episode.
            dt: sampling interval [s].
            generator: source of the coefficients a_k and b_k.
        """
        like: dict[str, Any] = {"dtype": torch.float64, "device": generator.device}
        reach = 9.0  # kernel and spectrum are below rounding there: e^{−9²/2} = e^{−40}
        period = n_steps * dt + reach * self.time_scale
        k = torch.arange(math.ceil(reach * period / (2.0 * math.pi * self.time_scale)) + 1, **like)
        omega = 2.0 * math.pi * k / period
        share = math.sqrt(2.0 * math.pi) * self.time_scale / period * torch.exp(-0.5 * (omega * self.time_scale) ** 2)
        amplitude = torch.sqrt(torch.where(k > 0, 2.0, 1.0) * share)
        a, b = torch.randn(2, batch, len(k), generator=generator, **like) * amplitude
        angle = omega.unsqueeze(-1) * dt * torch.arange(n_steps, **like)
        return self.mean + self.std * (a @ angle.cos() + b @ angle.sin())
