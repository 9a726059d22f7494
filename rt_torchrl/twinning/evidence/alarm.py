"""The alarm: the twin is wrong where it matters, in what a policy costs."""

import math
from collections.abc import Sequence

EPISODES = 5
"""Number of latest episodes that are compared."""
MATTERS = math.log(1.1)
"""Difference of log J below which a wrong twin does not matter."""
LEAST_DEVIATION = 0.05
"""Standard deviation of the paired differences of a sound twin, of log J; few episodes do not show a smaller one."""
GREAT = math.log(1.35)
"""Difference of log J beyond which a greater one says no more, so that a single bad policy does not hide the others."""
BEYOND_CHANCE = 3.0 * LEAST_DEVIATION
"""Difference of log J that two episodes in a row of a sound twin hardly ever have."""
ALONE = math.log(2.0)
"""Difference of log J that a single episode of a sound twin does not have."""
QUIET = 0.02
"""Exploration, as a share of half the ranges, above which the cost of an episode says little about its policy."""
CONFIDENCE = 0.975


def alarm(differences: Sequence[float]) -> str | None:
    r"""What is wrong with the twin, in plain words; None if nothing is.

    The mean of the paired differences :math:`d = \log J - \log\hat J` of the last episodes, each at most ``GREAT``, is
    off zero by Student's test with at least ``LEAST_DEVIATION``, and by more than matters; or the last two are both
    beyond chance to the same side; or the last one is beyond ``ALONE``.

    Args:
        differences: d of the latest quiet episodes, oldest first.
    """
    latest = list(differences)[-EPISODES:]
    n = len(latest)
    if n < 2:
        return None
    from scipy.stats import t as student  # here, because it takes a second to load

    counted = [max(-GREAT, min(GREAT, d)) for d in latest]
    mean = sum(counted) / n
    spread = math.sqrt(sum((d - mean) ** 2 for d in counted) / (n - 1))
    bound = student.ppf(CONFIDENCE, n - 1) * max(spread, LEAST_DEVIATION) / math.sqrt(n)
    if abs(mean) > max(bound, MATTERS):
        return wrong(latest)
    if twice(latest):
        return wrong(latest[-2:])
    return wrong(latest[-1:]) if abs(latest[-1]) > ALONE else None


def wrong(differences: Sequence[float]) -> str:
    """What is wrong with a twin of which the last episodes have these differences, in plain words."""
    mean = sum(differences) / len(differences)
    ratio, n = math.exp(abs(mean)), len(differences)
    episodes = "the last episode cost" if n == 1 else f"the last {n} episodes cost"
    relation = f"{ratio:.3g} times as much as" if mean > 0.0 else f"1/{ratio:.3g} of what"
    return f"the twin is wrong where it matters: {episodes} {relation} the twin says of {'it' if n == 1 else 'them'}"


def contradiction(withheld: float) -> str:
    """What is wrong with a twin whose plan real episodes contradict, in plain words.

    Args:
        withheld: log of the ratio of costs on the twin by which it prefers the plan to the policy that stays.
    """
    return (
        f"the twin is wrong where it matters: it says that a plan would cost 1/{math.exp(withheld):.3g} of the policy "
        "that stays, and by real episodes of that plan or of its neighbours it costs more"
    )


def twice(latest: Sequence[float]) -> bool:
    """Whether the last two differences are both beyond chance, to the same side."""
    before, now = latest[-2:]
    return min(before, now) > BEYOND_CHANCE or max(before, now) < -BEYOND_CHANCE
