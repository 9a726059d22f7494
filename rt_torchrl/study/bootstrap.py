"""Confidence intervals of mean costs."""

import numpy as np
from jaxtyping import Float

RESAMPLES = 2000


def mean_interval(costs: Float[np.ndarray, "seeds episodes"]) -> tuple[float, float]:
    """95 % percentile-bootstrap interval of the mean over seeds and episodes.

    Each resample draws seeds and episodes apart, because all seeds meet the same episodes.
    ``scipy.stats.bootstrap`` resamples along one axis only.
    """
    rng = np.random.default_rng(0)
    seeds, episodes = costs.shape
    rows = rng.integers(seeds, size=(RESAMPLES, seeds))
    columns = rng.integers(episodes, size=(RESAMPLES, episodes))
    means = [costs[np.ix_(r, c)].mean() for r, c in zip(rows, columns, strict=True)]
    # An episode that diverges costs infinitely, and nothing lies between infinity and infinity.
    low, high = np.percentile(means, [2.5, 97.5], method="linear" if np.isfinite(means).all() else "nearest")
    return float(low), float(high)
