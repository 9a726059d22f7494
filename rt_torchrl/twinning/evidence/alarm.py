"""The alarm: the twin is wrong where it matters, in what a policy costs."""

import math
from collections.abc import Sequence

EPISODES = 5
"""Number of latest episodes that are compared."""
MATTERS = math.log(1.1)
"""Difference of log J below which a wrong twin does not matter."""
LEAST_DEVIATION = 0.05
"""Standard deviation of the paired differences of a sound twin, of log J; few episodes do not show a smaller one."""
QUIET = 0.02
"""Exploration, as a share of half the ranges, above which the cost of an episode says little about its policy."""
CONFIDENCE = 0.975


def alarm(differences: Sequence[float]) -> str | None:
    r"""What is wrong with the twin, in plain words; None if nothing is.

    The mean of the paired differences :math:`d = \log J - \log\hat J` of the last episodes is off zero by Student's
    test with at least ``LEAST_DEVIATION``, and by more than matters.

    Args:
        differences: d of the latest quiet episodes, oldest first.
    """
    latest = list(differences)[-EPISODES:]
    n = len(latest)
    if n < 2:
        return None
    from scipy.stats import t as student  # here, because it takes a second to load

    mean = sum(latest) / n
    spread = math.sqrt(sum((d - mean) ** 2 for d in latest) / (n - 1))
    bound = student.ppf(CONFIDENCE, n - 1) * max(spread, LEAST_DEVIATION) / math.sqrt(n)
    if abs(mean) <= max(bound, MATTERS):
        return None
    ratio = math.exp(abs(mean))
    relation = f"{ratio:.3g} times as much as" if mean > 0.0 else f"1/{ratio:.3g} of what"
    return f"the twin is wrong where it matters: the last {n} episodes cost {relation} the twin says of them"
