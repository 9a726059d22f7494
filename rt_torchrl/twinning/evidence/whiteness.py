"""Whether what a replay leaves over is white noise, by the test of Ljung and Box."""

import torch
from jaxtyping import Float
from torch import Tensor

LAGS = 20
"""Greatest number of lags whose correlations count."""
LEAST = 10
"""Least number of samples of which correlations say anything."""
SIGNIFICANT = 0.01
"""Probability below which what a replay leaves over is no white noise."""
NOTHING = 1e-6
"""Residual, as a share of a signal's own deviation, below which nothing is left over but rounding."""


def whiteness(residuals: Float[Tensor, "n n_s"], signals: Float[Tensor, "n_read n_y"], *, lags: int = LAGS) -> float:
    r"""Probability that residuals of white noise would be correlated as much, in at least one signal.

    .. math:: Q = n(n + 2)\sum_{k=1}^m\frac{r_k^2}{n - k}

    For white noise Q has about the χ² distribution with m degrees of freedom. The least probability of the signals is
    multiplied by their number (Bonferroni). Residuals that are mere rounding count as white.

    Args:
        residuals: what the replay leaves over of each signal.
        signals: the signals as they were read.
        lags: greatest number m of lags; it is at most a fifth of the samples.

    Raises:
        ValueError: if the shapes differ, or there are fewer than ``LEAST`` samples.

    Source: Ljung, Box, *On a measure of lack of fit in time series models*, Biometrika 65, 1978.
    """
    n = len(residuals)
    if residuals.shape != signals.shape or n < LEAST:
        raise ValueError(
            f"residuals of shape {tuple(residuals.shape)} must have that of the signals, {tuple(signals.shape)}, and "
            "ten samples at least."
        )
    if not residuals.isfinite().all():
        return 0.0
    left = residuals - residuals.mean(0)
    spread = signals.std(0)
    left = left[:, left.square().mean(0).sqrt() > NOTHING * spread.clamp_min(signals.abs().mean(0) * NOTHING)]
    if not left.shape[1]:
        return 1.0
    from scipy.stats import chi2  # here, because it takes a second to load

    m = min(lags, n // 5)
    k = torch.arange(1, m + 1, dtype=torch.float64, device=left.device)
    correlations = torch.stack([(left[j:] * left[:-j]).sum(0) for j in range(1, m + 1)]) / left.square().sum(0)
    Q = n * (n + 2) * (correlations.square() / (n - k).unsqueeze(-1)).sum(0)
    least = min(float(chi2.sf(one, m)) for one in Q.tolist())
    return min(1.0, left.shape[1] * least)
